// The page of an attack: the clean and the adversarial picture under one slider, and the search step by step.
"use strict";
(() => {
  const PLAYED = 160; // milliseconds a frame

  function compare(place) {
    const [clean, adversarial] = ["clean", "adversarial"].map((name) => document.querySelector(`img[data-picture="${name}"]`));
    if (!clean || !adversarial) return;
    const over = adversarial.cloneNode();
    over.classList.add("over");
    for (const one of [over]) one.removeAttribute("data-picture");
    const under = clean.cloneNode();
    under.removeAttribute("data-picture");
    const stage = make("div", { class: "stage" }, under, over);
    const slide = (value) => stage.style.setProperty("--shown", `${value}%`);
    const input = make("input", { type: "range", min: 0, max: 100, value: 50, "aria-label": "where the clean picture ends and the adversarial one begins", oninput: (event) => slide(event.target.value) });
    slide(50);
    place.append(stage, make("label", { class: "ends" }, make("span", {}, "clean"), input, make("span", {}, "adversarial")));
    place.closest("[hidden]").hidden = false;
  }

  function frames(place) {
    const { pictures, steps, objectives } = JSON.parse(document.getElementById("frames").textContent);
    const image = make("img", { alt: "", src: pictures[0] });
    const text = make("p", { class: "status", role: "status" });
    let at = pictures.length - 1, timer = null;
    const input = make("input", { type: "range", min: 0, max: pictures.length - 1, value: at, "aria-label": "step of the search", oninput: (event) => { stop(); show(Number(event.target.value)); } });
    const button = make("button", { type: "button", onclick: () => (timer === null ? play() : stop()) }, "Play");
    function words(k) {
      if (k === pictures.length - 1) return "the adversarial scene";
      const objective = objectives[k];
      return `step ${steps[k]}${objective === null || objective === undefined ? "" : `, objective ${objective.toFixed(2)}`}`;
    }
    function show(k) {
      at = k;
      image.src = pictures[k];
      image.alt = `the search at ${words(k)}`;
      input.value = k;
      input.setAttribute("aria-valuetext", words(k));
      text.textContent = words(k);
    }
    function stop() {
      clearInterval(timer);
      timer = null;
      button.textContent = "Play";
    }
    function play() {
      if (at === pictures.length - 1) show(0);
      button.textContent = "Stop";
      timer = setInterval(() => (at + 1 < pictures.length ? show(at + 1) : stop()), PLAYED);
    }
    place.append(image, make("label", { class: "ends" }, input), make("p", { class: "options" }, button, text));
    show(at);
    place.closest("[hidden]").hidden = false;
  }

  const both = document.getElementById("compare"), search = document.getElementById("search");
  if (both) compare(both);
  if (search) frames(search);
})();
