// A run that goes on: its search as a curve and step by step; asks the server it came from for what is new.
"use strict";
(() => {
  const SOON = 1000, LATER = 5000, PLAYED = 160; // milliseconds between questions while it runs and where it was stopped; a frame
  const given = JSON.parse(document.getElementById("run").textContent), place = document.getElementById("follow");
  const state = document.getElementById("state"), svg = "http://www.w3.org/2000/svg";
  const rows = { search: [], baseline: [] }, counts = new Map(), pictures = [];
  let next = given.start, best = null, shown = -1, timer = null;

  const picture = make("img", { alt: "" }), words = make("p", { class: "status" }); // changes each second: the slider tells it to who listens
  const slider = make("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": "step of the search", oninput: (event) => { stop(); show(Number(event.target.value)); } });
  const button = make("button", { type: "button", onclick: () => (timer === null ? play() : stop()) }, "Play");
  const search = make("div", { id: "search", hidden: "" }, picture, make("label", { class: "ends" }, slider), make("p", { class: "options" }, button, words));
  const curve = document.createElementNS(svg, "svg"), table = make("tbody"), values = make("table", { class: "facts", hidden: "" }, make("caption", {}, "The best so far"), table);
  curve.setAttribute("class", "along");
  curve.setAttribute("role", "img");
  const note = make("p", { class: "soft" }, "Objective over steps. Lines: the best so far, of the search and, dashed, of the random search beside it.");
  place.append(search, make("div", {}, curve, note), values);

  // ---- step by step ------------------------------------------------------------------------------------------------

  function show(number) {
    shown = number;
    const { step, picture: data } = pictures[number], row = rows.search[step];
    const told = `step ${step}${row && row.objective !== null ? `, objective ${row.objective.toFixed(2)}` : ""}${row && row.label ? `, prediction ${row.label}` : ""}`;
    picture.src = data;
    picture.alt = `the search at ${told}`;
    slider.value = number;
    slider.setAttribute("aria-valuetext", told);
    words.textContent = told;
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    button.textContent = "Play";
  }
  function play() {
    if (shown === pictures.length - 1) show(0);
    button.textContent = "Stop";
    timer = setInterval(() => (shown + 1 < pictures.length ? show(shown + 1) : stop()), PLAYED);
  }

  // ---- the curve ---------------------------------------------------------------------------------------------------

  function draw() {
    const [wide, high, left, below] = [Math.min(place.clientWidth, 720), 220, 52, 22], all = Object.values(rows).flat().map((one) => one.objective).filter((one) => one !== null);
    if (!all.length) return;
    const count = Math.max(...Object.values(rows).map((one) => one.length), 2), low = Math.min(...all), range = Math.max(...all) - low || 1;
    const x = (step) => left + ((wide - left - 8) * step) / (count - 1), y = (value) => 8 + (high - below - 8) * (1 - (value - low) / range);
    const parts = [];
    const add = (tag, attributes, text) => {
      const element = document.createElementNS(svg, tag);
      for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
      if (text !== undefined) element.textContent = text;
      parts.push(element);
    };
    for (const [name, colour] of [["baseline", "s1"], ["search", "s0"]]) {
      let top = -Infinity, line = "";
      const every = Math.ceil(rows[name].length / 400);
      rows[name].forEach(({ objective }, step) => {
        if (objective !== null) top = Math.max(top, objective);
        if (step % every && step !== rows[name].length - 1) return;
        if (objective !== null) add("circle", { cx: x(step), cy: y(objective), r: 2.5, class: colour, fill: "currentColor", opacity: 0.5 });
        if (top > -Infinity) line += `${line ? "L" : "M"}${x(step).toFixed(1)} ${y(top).toFixed(1)}`;
      });
      add("path", { d: line, class: colour, fill: "none", stroke: "currentColor", "stroke-width": 2, "stroke-dasharray": name === "baseline" ? "6 3" : "none" });
    }
    for (const value of [low, low + range]) add("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, value.toFixed(2));
    for (const step of [0, count - 1]) add("text", { x: x(step), y: high - 6, "text-anchor": step ? "end" : "start" }, step);
    curve.replaceChildren(...parts);
    curve.setAttribute("viewBox", `0 0 ${wide} ${high}`);
    curve.setAttribute("aria-label", `objective over ${rows.search.length} steps of the search, from ${low.toFixed(2)} to ${(low + range).toFixed(2)}`);
  }

  // ---- what is new -------------------------------------------------------------------------------------------------

  function take(news) {
    next = news.next;
    for (const row of news.rows) {
      counts.set(row.kind, (counts.get(row.kind) || 0) + 1);
      if (rows[row.kind]) rows[row.kind][row.step] = row;
      if (row.kind === "search" && row.objective !== null && (best === null || row.objective > best.objective)) best = row;
    }
    const last = shown === pictures.length - 1;
    pictures.push(...news.pictures);
    slider.max = Math.max(pictures.length - 1, 0);
    search.hidden = !pictures.length;
    if (news.pictures.length && last && timer === null) show(pictures.length - 1);
    if (news.rows.length) draw();
    if (best) {
      const number = (value) => (typeof value === "number" ? Number(value.toPrecision(4)) : value);
      const lines = Object.entries(best.values).map(([name, [value, unit]]) => [name, `${[value].flat().map(number).join(", ")} ${unit === "1" ? "" : unit}`]);
      table.replaceChildren(...[["objective", `${best.objective.toFixed(3)} at step ${best.step}`], ["prediction", best.label ?? ""], ...lines]
        .map(([name, text]) => make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, text))));
      values.hidden = false;
    }
    const kept = [...counts].map(([kind, count]) => `${count} of ${kind}`).join(", ") || "none";
    state.textContent = `${news.running ? "A process is working on it." : "It was stopped; advsearch resume goes on."} Evaluations so far: ${kept}.`;
  }

  async function ask() {
    let wait = LATER;
    try {
      const answer = await fetch(`${given.progress}?after=${next}`);
      if (answer.ok) {
        const before = next, news = await answer.json();
        if (news.ended && !news.rows.length) { // its page says what came out
          location.reload();
          return;
        }
        take(news);
        wait = next !== before && news.rows.length > 1000 ? 0 : news.running ? SOON : LATER;
      } else state.textContent = "The run is not there any more, or damaged.";
    } catch {
      state.textContent = "The dashboard does not answer.";
    }
    setTimeout(ask, wait);
  }
  ask();
})();
