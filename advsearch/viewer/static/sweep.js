// The explorer of a sweep: two parameters across a map, the others at one value or over all, and the pictures behind a
// cell. Rows come as columns of numbers (advsearch/viewer/columns.py); everything below is counted from them here.
"use strict";
(() => {
  const MOST_LEVELS = 40; // different numbers of a parameter that are shown one by one; of more, parts of its range
  const PARTS = 10; // into which a range is cut of which the rows do not say the parts
  const SHOWN = 48; // pictures of the gallery at once
  const FOLLOW = 3000; // milliseconds between two looks at a sweep that goes on
  const MAP = [[0, 34, 78], [42, 63, 108], [87, 93, 109], [127, 124, 117], [166, 157, 117], [210, 193, 101], [254, 232, 56]];
  const KINDS = { uint32: Uint32Array, float32: Float32Array, uint16: Uint16Array, uint8: Uint8Array };
  const UNKNOWN = 2, NO_PROBABILITY = 65535, NO_BOX = 65535, BOX_STEPS = 8, OF_A_BOX = 6;
  const SURE = 0.5; // least score of a box that is drawn on a small picture
  const MOST_GROUPS = 40, IN_A_GROUP = 12;
  const DRIVE = "drive", BY = "by ";
  const PEEKED = 4; // pictures beside a cell that is pointed at
  const OVERALL = "all values", ACROSS = "across", UP = "up", ONE = "one value";

  // ---- elements ----------------------------------------------------------------------------------------------------

  function make(tag, given = {}, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(given)) {
      if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
      else if (name === "style") for (const [key, text] of Object.entries(value)) element.style.setProperty(key, text);
      else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value === true ? "" : value);
    }
    element.append(...children.filter((child) => child !== null));
    return element;
  }

  function drawn(tag, given = {}, ...children) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(given)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  }

  function choice(label, options, value, told) {
    const select = make("select", { "aria-label": label, onchange: (event) => told(event.target.value) });
    for (const [name, text] of options) select.append(make("option", { value: name, selected: name === value }, text));
    return make("label", {}, make("span", {}, label), select);
  }

  // Puts others in the place of what is in an element; who was on a list by keys stays on it.
  function renewed(place, ...children) {
    const was = place.contains(document.activeElement) ? document.activeElement.getAttribute("aria-label") : null;
    place.replaceChildren(...children);
    if (was) for (const one of place.querySelectorAll("[aria-label]")) if (one.getAttribute("aria-label") === was) one.focus();
  }

  // ---- numbers -----------------------------------------------------------------------------------------------------

  // As `percent_number` in advsearch/report/wording.py.
  function percentNumber(share, most = 4) {
    const value = 100 * share, away = Math.min(value, 100 - value);
    if (away >= 5 || away <= 0) return String(Math.round(value));
    const decimals = Math.min(Math.max(1, -Math.floor(Math.log10(away))), most), rounded = Number(value.toFixed(decimals)), least = 10 ** -decimals;
    return rounded === 0 ? `under ${least.toFixed(decimals)}` : rounded === 100 ? `over ${(100 - least).toFixed(decimals)}` : String(rounded);
  }
  const percent = (share, most) => (share === null ? "none" : `${percentNumber(share, most)}\u00a0%`);
  // A prediction with its number, by what judges it: as `cells` there.
  function said(task, label, share, outcome) {
    if (share === null) return label;
    const missed = outcome === "missed";
    if (task === "detection") return missed ? `${label} found (best score ${share.toFixed(2)})` : `${label} (score ${share.toFixed(2)})`;
    if (task === "segmentation") return missed ? `${label} found, accuracy ${percent(share)}` : outcome === "loose" ? `${label}, accuracy ${percent(share)}` : `accuracy ${percent(share)}, most often ${label}`;
    return `${label} ${percent(share, 1)}`;
  }
  const short = (value) => (Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(4))));
  // The last part of each path, with as much before it as tells it from the others; names stay as they are.
  function shortened(names) {
    const parts = names.map((name) => name.split(/[\\/]/).filter(Boolean)), found = [...names];
    let open = names.map((_, k) => k).filter((k) => parts[k].length > 1);
    for (let count = 1; open.length; count++) {
      const ends = parts.map((one) => one.slice(-count).join("/")), times = new Map();
      for (const end of ends) times.set(end, (times.get(end) || 0) + 1);
      for (const k of open) if (times.get(ends[k]) === 1) found[k] = ends[k];
      open = open.filter((k) => times.get(ends[k]) > 1 && count + 1 < parts[k].length);
    }
    return found;
  }
  const cut = (text, letters) => (text.length > letters ? `${text.slice(0, Math.max(letters - 1, 1))}…` : text);
  const named = (name, unit) => (unit && unit !== "name" && unit !== "1" ? `${name} [${unit}]` : name);

  const factorials = [0];
  function logFactorial(n) {
    if (n > 2000) return n * Math.log(n) - n + 0.5 * Math.log(2 * Math.PI * n) + 1 / (12 * n);
    for (let k = factorials.length; k <= n; k++) factorials.push(factorials[k - 1] + Math.log(k));
    return factorials[n];
  }

  // The regularised incomplete beta function of whole numbers by Lentz's continued fraction (Press et al., Numerical
  // Recipes, 6.4).
  function beta(x, a, b) {
    if (x <= 0 || x >= 1) return x <= 0 ? 0 : 1;
    if (x > (a + 1) / (a + b + 2)) return 1 - beta(1 - x, b, a);
    const front = Math.exp(logFactorial(a + b - 1) - logFactorial(a - 1) - logFactorial(b - 1) + a * Math.log(x) + b * Math.log1p(-x)) / a;
    let c = 1, d = 1 / (1 - ((a + b) * x) / (a + 1)), result = d;
    for (let m = 1; m < 400; m++) {
      for (const term of [(m * (b - m) * x) / ((a + 2 * m - 1) * (a + 2 * m)), (-(a + m) * (a + b + m) * x) / ((a + 2 * m) * (a + 2 * m + 1))]) {
        d = 1 / (1 + term * d);
        c = 1 + term / c;
        result *= c * d;
      }
      if (Math.abs(c * d - 1) < 1e-12) break;
    }
    return front * result;
  }

  const intervals = new Map();
  // The interval of Clopper and Pearson (1934) at 95 %.
  function interval(right, count) {
    const key = right * 4294967296 + count;
    if (!intervals.has(key)) {
      const solve = (low, high, wanted) => {
        for (let k = 0; k < 40; k++) {
          const middle = (low + high) / 2;
          if (wanted(middle)) high = middle; else low = middle;
        }
        return (low + high) / 2;
      };
      const low = right === 0 ? 0 : solve(0, right / count, (x) => beta(x, right, count - right + 1) > 0.025);
      const high = right === count ? 1 : solve(right / count, 1, (x) => beta(x, right + 1, count - right) > 0.975);
      intervals.set(key, [low, high]);
    }
    return intervals.get(key);
  }

  const STAKES = [1, 0.9, 0.75, 0.5, 0.25, 0.125, 0.0625, 0.03125], ENOUGH = Math.log(40);
  const overUnits = new Map();
  // The interval of the mean over units (drives) of the share of each, by bets (attacks/trials.py), from what units come
  // to: [right, rows, how many units].
  function intervalOver(units) {
    const key = units.map((one) => one.join(" ")).sort().join();
    if (!overUnits.has(key)) {
      const won = (mean, wrong) => {
        const totals = STAKES.map((stake) => units.reduce((sum, [right, of, times]) => sum + times * Math.log(Math.max(0, 1 - stake + (stake * (wrong ? of - right : right)) / (of * mean))), 0));
        const top = Math.max(...totals);
        return top === -Infinity ? top : top + Math.log(totals.reduce((sum, one) => sum + Math.exp(one - top), 0) / STAKES.length);
      };
      const solve = (beyond) => {
        let low = 0, high = 1;
        for (let k = 0; k < 40; k++) {
          const middle = (low + high) / 2;
          if (beyond(middle)) high = middle; else low = middle;
        }
        return (low + high) / 2;
      };
      overUnits.set(key, [solve((mean) => won(mean, false) < ENOUGH), solve((mean) => won(1 - mean, true) >= ENOUGH)]);
    }
    return overUnits.get(key);
  }

  function colour(share) {
    const place = Math.min(Math.max(share, 0), 1) * (MAP.length - 1);
    const first = Math.min(Math.floor(place), MAP.length - 2);
    const mixed = MAP[first].map((low, k) => Math.round(low + (MAP[first + 1][k] - low) * (place - first)));
    const light = 0.2126 * (mixed[0] / 255) ** 2.2 + 0.7152 * (mixed[1] / 255) ** 2.2 + 0.0722 * (mixed[2] / 255) ** 2.2;
    return { background: `rgb(${mixed.join(",")})`, color: light > 0.179 ? "#000" : "#fff" };
  }

  // ---- rows --------------------------------------------------------------------------------------------------------

  function unpacked(buffer) {
    const size = new DataView(buffer).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
    const arrays = {};
    for (const one of head.columns) arrays[one.name] = new KINDS[one.type](buffer, 4 + size + one.at, one.length === undefined ? head.count * (one.width || 1) : one.length);
    return { head, arrays };
  }

  // Rows of several sweeps, or of one that goes on, one behind the other.
  class Table {
    constructor() {
      this.count = 0;
      this.parameters = [];
      this.answers = [];
      this.outcomes = [];
      this.sources = [];
      this.columns = { step: new Uint32Array(0), unit: new Uint32Array(0), margin: new Float32Array(0), answer: new Uint16Array(0), outcome: new Uint16Array(0), probability: new Uint16Array(0), right: new Uint8Array(0), source: new Uint16Array(0), boxes: null, others: null };
      this.things = [];
    }

    add({ head, arrays }, source) {
      const before = this.count, count = before + head.count;
      const grown = (array, kind, empty) => {
        const larger = new kind(count);
        if (empty !== undefined) larger.fill(empty);
        if (array) larger.set(array);
        return larger;
      };
      for (const name of ["step", "unit", "margin", "probability", "right"]) {
        this.columns[name] = grown(this.columns[name], this.columns[name].constructor);
        this.columns[name].set(arrays[name], before);
      }
      this.columns.source = grown(this.columns.source, Uint16Array);
      this.columns.source.fill(source, before);
      if (arrays.boxes || this.columns.boxes) {
        const boxes = new Uint16Array(8 * count).fill(NO_BOX);
        if (this.columns.boxes) boxes.set(this.columns.boxes);
        if (arrays.boxes) boxes.set(arrays.boxes, 8 * before);
        this.columns.boxes = boxes;
      }
      if (arrays.others) this.addOthers(arrays, this.places(this.things, head.things), before, count);
      this.columns.answer = grown(this.columns.answer, Uint16Array);
      this.put(this.columns.answer, arrays.answer, this.places(this.answers, head.answers), before);
      this.columns.outcome = grown(this.columns.outcome, Uint16Array);
      this.put(this.columns.outcome, arrays.outcome, this.places(this.outcomes, head.outcomes), before);
      head.parameters.forEach((given, number) => {
        const names = given.levels !== null;
        let mine = this.parameters.find((one) => one.name === given.name && (one.levels !== null) === names);
        if (!mine) {
          mine = { name: given.name, unit: given.unit, levels: names ? [] : null, edges: given.edges, data: null };
          if (names && before) mine.levels.push("none");
          this.parameters.push(mine);
        }
        if (String(mine.edges) !== String(given.edges)) mine.edges = null; // sweeps over different ranges
        mine.data = grown(mine.data, names ? Uint16Array : Float32Array, names ? undefined : NaN);
        const from = arrays[`parameter ${number}`];
        if (names) this.put(mine.data, from, this.places(mine.levels, given.levels), before);
        else mine.data.set(from, before);
      });
      this.count = count;
      this.order = this.pairs = null;
      for (const one of this.parameters) {
        if (one.data.length === count) continue;
        const missing = one.levels ? this.places(one.levels, ["none"])[0] : NaN;
        one.data = grown(one.data, one.data.constructor, missing);
      }
    }

    // All boxes of rows, one list behind the other: where each row's end is, and six numbers a box.
    addOthers({ others, "others end": ends }, names, before, count) {
      const { ends: old, list } = this.columns.others || { ends: new Uint32Array(0), list: new Uint16Array(0) };
      const joined = new Uint16Array(list.length + others.length), places = new Uint32Array(count).fill(list.length / OF_A_BOX);
      joined.set(list);
      joined.set(others, list.length);
      for (let at = list.length + 4; at < joined.length; at += OF_A_BOX) joined[at] = names[joined[at]];
      places.set(old);
      for (let k = 0; k < ends.length; k++) places[before + k] = ends[k] + list.length / OF_A_BOX;
      this.columns.others = { ends: places, list: joined };
    }

    // The rows, those of one unit of sampling beside each other; empty where each is a unit of its own.
    byUnit() {
      if (this.order) return this.order;
      const { unit, source } = this.columns, order = Uint32Array.from({ length: this.count }, (_, k) => k);
      order.sort((a, b) => source[a] - source[b] || unit[a] - unit[b]);
      this.shared = order.some((k, place) => place > 0 && unit[k] === unit[order[place - 1]] && source[k] === source[order[place - 1]]);
      this.order = this.shared ? order : new Uint32Array(0);
      return this.order;
    }

    places(known, names) {
      return names.map((name) => {
        if (!known.includes(name)) known.push(name);
        return known.indexOf(name);
      });
    }

    put(target, from, places, before) {
      for (let k = 0; k < from.length; k++) target[before + k] = places[from[k]];
    }

    // Each parameter with what it is shown by: names, its numbers one by one, or parts of its range.
    axes() {
      const made = this.parameters.map((one) => this.axis(one)).filter((one) => one.labels.length > 1);
      const drives = this.drives(made);
      if (drives) made.push(drives);
      if (this.sources.length > 1) made.unshift({ name: "run", unit: "", labels: this.sources.map((one) => one.name), level: this.columns.source, names: true });
      return made;
    }

    // Which drive each row is of, named by what stays the same in each; null where rows are of none.
    drives(axes) {
      const order = this.byUnit(), { unit, source } = this.columns;
      if (!order.length || !this.sources.some((one) => one.drives)) return null;
      const level = new Uint16Array(this.count), first = [];
      const still = new Set(axes);
      order.forEach((k, at) => {
        if (!at || unit[k] !== unit[order[at - 1]] || source[k] !== source[order[at - 1]]) first.push(k);
        else for (const axis of still) if (axis.level[k] !== axis.level[first[first.length - 1]]) still.delete(axis);
        level[k] = first.length - 1;
      });
      const labels = first.map((k, at) => [`${at + 1}`, ...[...still].map((axis) => `${axis.names ? "" : `${axis.name} `}${axis.labels[axis.level[k]]}`)].join(", "));
      return first.length > 65535 ? null : { name: DRIVE, unit: "", labels, full: labels, level, names: true };
    }

    axis({ name, unit, levels, edges, data }) {
      if (levels) return { name, unit, labels: shortened(levels), full: levels, level: data, names: true };
      const seen = new Set();
      for (let k = 0; k < data.length && seen.size <= MOST_LEVELS; k++) if (!Number.isNaN(data[k])) seen.add(data[k]);
      const parts = Boolean(edges) || seen.size > MOST_LEVELS;
      const level = new Uint16Array(data.length);
      let labels, place;
      if (edges) { // the parts of the table in the terminal (questions/sweep/points.py), ascending
        const inner = Float32Array.from(edges.slice(1, -1));
        labels = edges.slice(1).map((end, k) => `${short(edges[k])} to ${short(end)}`);
        place = (value) => inner.reduce((sum, edge) => sum + (value >= edge), 0);
      } else if (!parts) {
        const sorted = [...seen].sort((a, b) => a - b);
        labels = sorted.map(short);
        const index = new Map(sorted.map((value, k) => [value, k]));
        place = (value) => index.get(value);
      } else {
        let low = Infinity, high = -Infinity;
        for (let k = 0; k < data.length; k++) {
          if (data[k] < low) low = data[k];
          if (data[k] > high) high = data[k];
        }
        const width = (high - low) / PARTS;
        const digits = Math.max(0, 2 - Math.floor(Math.log10(high - low)));
        const end = (k) => String(Number((low + k * width).toFixed(Math.min(digits, 12))));
        labels = Array.from({ length: PARTS }, (_, k) => `${end(k)} to ${end(k + 1)}`);
        place = (value) => Math.min(PARTS - 1, Math.floor((value - low) / width));
      }
      let missing = false;
      for (let k = 0; k < data.length; k++) {
        if (Number.isNaN(data[k])) {
          level[k] = labels.length;
          missing = true;
        } else level[k] = place(data[k]);
      }
      if (missing) labels = [...labels, "none"];
      return { name, unit, labels, level, names: false, parts };
    }
  }

  // ---- the explorer ------------------------------------------------------------------------------------------------

  const SHOWS = [["all", "all"], ["wrong", "wrong predictions"], ["right", "right predictions"], ["differ", "where runs differ"]];
  const ORDERS = [["worst", "worst margin"], ["best", "best margin"], ["first", "as they were made"]];

  class Explorer {
    constructor(place, table) {
      this.place = place;
      this.table = table;
      this.state = { across: null, up: null, by: null, measure: "accuracy", fixed: {}, cell: null, show: "all", order: "worst", find: "", group: null };
      this.parts = { peek: make("div", { class: "peek", hidden: true, "aria-hidden": "true" }), controls: make("div", { class: "parameters" }), options: make("div", { class: "options" }), maps: make("div", { class: "maps" }), legend: make("div", { class: "legend" }), status: make("p", { class: "status", role: "status", "aria-live": "polite" }), alongs: make("div", { class: "alongs" }), gallery: make("div", {}), bar: make("div", { class: "options" }), find: this.finder() };
      const heading = (text) => make("h2", {}, text);
      place.append(heading("Accuracy over two parameters"), this.parts.options, this.parts.controls, this.parts.maps, this.parts.legend, this.parts.status, heading("Pictures"), this.parts.bar, this.parts.gallery, heading("Along each parameter"), make("p", { class: "soft" }, "Accuracy with its 95 % interval, over what is chosen above: Clopper and Pearson's, and where rows share a draw (frames of a drive, models that are shown one picture) one over draws, by bets."), this.parts.alongs, this.parts.peek);
      window.addEventListener("hashchange", () => this.arrive());
    }

    finder() {
      let waits = null;
      return make("label", { class: "find" }, make("span", {}, "Search"), make("input", { type: "search", placeholder: "truck, or camera.distance over 30", title: "Words of predictions and names, numbers of configurations, and conditions as rules say them: camera.distance over 30 and pose.yaw from 340 to 20", oninput: (event) => {
        clearTimeout(waits);
        waits = setTimeout(() => this.change({ find: event.target.value }), 200);
      } }));
    }

    // The rows have grown.
    renew() {
      this.known = null;
      this.axes = this.table.axes();
      this.byName = new Map(this.axes.map((axis) => [axis.name, axis]));
      this.read();
      this.show();
    }

    arrive() {
      if (location.hash.slice(1) === this.written()) return;
      this.read();
      this.show();
    }

    read() {
      const given = new URLSearchParams(location.hash.slice(1));
      const state = this.state;
      // First the axes of the grid, then numbers that follow from these, then those that were drawn, then names.
      const grid = new Set(this.table.sources.flatMap((one) => one.grid || []));
      const rank = (axis) => (axis.names ? 3 : axis.parts ? 2 : grid.has(axis.name) ? 0 : 1);
      const order = [...this.axes].sort((a, b) => rank(a) - rank(b));
      const drives = this.byName.get(DRIVE), time = this.axes.find((axis) => axis.name.endsWith(".time"));
      if (drives && time && drives.labels.length <= MOST_LEVELS) order.unshift(time, drives); // a drive is seen from left to right
      const pick = (name, other) => (this.byName.has(name) ? name : (order.find((axis) => axis.name !== other) || {}).name || null);
      state.across = pick(given.get("across"), given.get("up"));
      state.up = pick(given.get("up") === state.across ? null : given.get("up"), state.across);
      if (state.up === state.across) state.up = null;
      const by = given.has("by") ? given.get("by") : "run"; // several runs stand side by side unless asked otherwise
      state.by = this.byName.has(by) && by !== state.across && by !== state.up ? by : null;
      state.measure = ["accuracy", "margin", "count"].includes(given.get("measure")) ? given.get("measure") : "accuracy";
      state.show = SHOWS.map(([name]) => name).includes(given.get("show")) ? given.get("show") : "all";
      const known = [...ORDERS, ...this.numbers()].map(([name]) => name);
      state.order = known.includes(given.get("order")) ? given.get("order") : drives ? "first" : "worst";
      state.find = given.get("find") || "";
      const group = given.has("group") ? given.get("group") : drives ? DRIVE : null;
      state.group = this.groups().some(([name]) => name && name === group) ? group : null;
      state.fixed = {};
      for (const axis of this.axes) {
        const level = axis.labels.indexOf(given.get(`at.${axis.name}`));
        if (level >= 0 && axis.name !== state.across && axis.name !== state.up) state.fixed[axis.name] = level;
      }
      const cell = (given.get("cell") || "").split(",").map(Number);
      state.cell = cell.length === 3 && cell.every(Number.isInteger) ? cell : null;
    }

    written() {
      const state = this.state, out = new URLSearchParams();
      for (const name of ["across", "up", "by"]) if (state[name] || (name === "by" && this.byName.has("run"))) out.set(name, state[name] || "");
      if (state.measure !== "accuracy") out.set("measure", state.measure);
      if (state.show !== "all") out.set("show", state.show);
      const drives = this.byName.has(DRIVE);
      if (state.order !== (drives ? "first" : "worst")) out.set("order", state.order);
      if (state.group !== (drives ? DRIVE : null)) out.set("group", state.group || "");
      if (state.find) out.set("find", state.find);
      for (const [name, level] of Object.entries(state.fixed)) out.set(`at.${name}`, this.byName.get(name).labels[level]);
      if (state.cell) out.set("cell", state.cell.join(","));
      return out.toString();
    }

    change(some) {
      Object.assign(this.state, some);
      history.replaceState(null, "", `#${this.written()}`);
      this.show();
    }

    show() {
      const fixed = JSON.stringify([this.state.fixed, this.state.find]);
      if (!this.known || this.known.fixed !== fixed) {
        this.known = { fixed, counts: new Map() };
        this.kept = this.chosen();
      }
      this.showControls();
      this.showMaps();
      this.showAlong();
      this.showGallery();
    }

    // Which rows have the values that are fixed; null where all have.
    chosen() {
      const fixed = Object.entries(this.state.fixed), wanted = this.wanted(this.state.find);
      if (!fixed.length && !wanted.length) return null;
      const kept = new Uint8Array(this.table.count).fill(1);
      for (const holds of wanted) for (let k = 0; k < kept.length; k++) if (kept[k] && !holds(k)) kept[k] = 0;
      for (const [name, level] of fixed) {
        const levels = this.byName.get(name).level;
        for (let k = 0; k < kept.length; k++) if (levels[k] !== level) kept[k] = 0;
      }
      return kept;
    }

    // What is searched for, each a function of the row: conditions as rules say them ("camera.distance over 30 metres
    // and pose.yaw from 340 to 20 degrees"), then words, each of which the prediction, a name or a number has.
    wanted(text) {
      const found = [], { answer, source, step } = this.table.columns, number = "(-?[\\d.]+(?:e[-+]?\\d+)?)";
      const plain = (name) => name.toLowerCase().replace(/[.*+?^${}()|[\]\\]/g, "\\$&");
      const end = `(over|at most) ${number}`, arc = `from ${number} to ${number}`;
      let left = text.toLowerCase();
      for (const { name, unit, levels, data } of [...this.table.parameters].sort((a, b) => b.name.length - a.name.length)) {
        const one = levels ? `(?:${levels.map(plain).sort((a, b) => b.length - a.length).join("|")})` : "";
        const said = levels ? `${one}(?: or ${one})*` : `(?:${end}(?: and ${end})?|${arc}(?: or ${arc})*)`;
        left = left.replace(new RegExp(`(?<![\\w.])${plain(name)} (${said})(?: ${plain(unit || " ")})?(?![\\w.])`, "g"), (_, told) => {
          if (levels) {
            const names = told.split(" or "), has = levels.map((level) => names.includes(level.toLowerCase()));
            found.push((k) => has[data[k]]);
            return " ";
          }
          const ends = [...told.matchAll(new RegExp(end, "g"))].map(([, which, at]) => (k) => (which === "over" ? data[k] > at : data[k] <= at));
          const arcs = [...told.matchAll(new RegExp(arc, "g"))].map(([, from, to]) => (k) => {
            const low = Number(from), high = Number(to), value = ((data[k] % 360) + 360) % 360;
            return low <= high ? value >= low && value <= high : value >= low || value <= high;
          });
          found.push((k) => ends.every((holds) => holds(k)) && (!arcs.length || arcs.some((holds) => holds(k))));
          return " ";
        });
      }
      for (const word of left.split(/[\s,]+/).filter((one) => one && one !== "and")) {
        const has = (name) => name.toLowerCase().includes(word);
        const answers = this.table.answers.map(has), runs = this.table.sources.map((one) => has(one.name));
        const named = this.table.parameters.filter((one) => one.levels).map((one) => [one.data, one.levels.map(has)]);
        found.push((k) => answers[answer[k]] || runs[source[k]] || String(step[k]) === word || named.some(([data, levels]) => levels[data[k]]));
      }
      return found;
    }

    // Parameters that are numbers, as orders of pictures.
    numbers() {
      return this.axes.filter((axis) => !axis.names).map((axis) => [`${BY}${axis.name}`, `${axis.name}, rising`]);
    }

    groups() {
      return [["", "nothing"], ["prediction", "prediction"], ["verdict", "right or wrong"], ...(this.table.outcomes.some(Boolean) ? [["outcome", "what becomes of it"]] : []), ...this.axes.map((axis) => [axis.name, axis.name])];
    }

    // Counts over up to three axes, the last one fastest; kept until other rows are chosen.
    counted(axes) {
      const name = axes.map((axis) => axis.name).join("\n");
      if (!this.known.counts.has(name)) this.known.counts.set(name, this.count(axes));
      return this.known.counts.get(name);
    }

    count(axes) {
      const sizes = axes.map((axis) => axis.labels.length), size = sizes.reduce((a, b) => a * b, 1);
      const all = new Float64Array(size), right = new Float64Array(size), judged = new Float64Array(size), margin = new Float64Array(size), margins = new Float64Array(size);
      const { right: verdict, margin: given } = this.table.columns, kept = this.kept;
      const levels = axes.map((axis) => axis.level);
      for (let k = 0; k < this.table.count; k++) {
        if (kept && !kept[k]) continue;
        let place = 0;
        for (let a = 0; a < levels.length; a++) place = place * sizes[a] + levels[a][k];
        all[place] += 1;
        if (verdict[k] !== UNKNOWN) {
          judged[place] += 1;
          right[place] += verdict[k];
        }
        if (given[k] === given[k]) {
          margin[place] += given[k];
          margins[place] += 1;
        }
      }
      return { all, right, judged, margin, margins, units: this.unitsOf(levels, sizes) };
    }

    // What the units of each place come to: "right of rows", and how many units do; null where each row is a unit.
    unitsOf(levels, sizes) {
      const order = this.table.byUnit(), { right: verdict, unit, source } = this.table.columns, kept = this.kept;
      if (!order.length) return null;
      const found = new Map();
      let mine = new Map();
      order.forEach((k, at) => {
        if ((!kept || kept[k]) && verdict[k] !== UNKNOWN) {
          let place = 0;
          for (let a = 0; a < levels.length; a++) place = place * sizes[a] + levels[a][k];
          const [right, of] = mine.get(place) || [0, 0];
          mine.set(place, [right + verdict[k], of + 1]);
        }
        const next = order[at + 1];
        if (next !== undefined && unit[next] === unit[k] && source[next] === source[k]) return;
        for (const [place, [right, of]] of mine) {
          if (!found.has(place)) found.set(place, new Map());
          const key = `${right} ${of}`;
          found.get(place).set(key, (found.get(place).get(key) || 0) + 1);
        }
        mine = new Map();
      });
      return found;
    }

    // What the units of a place come to, where some have several rows: [right, rows, how many units]; null elsewhere.
    several(counts, place) {
      const units = counts.units && counts.units.get(place);
      const told = units && [...units].map(([key, times]) => [...key.split(" ").map(Number), times]);
      return told && told.some(([, of]) => of > 1) ? told : null;
    }

    interval(counts, place) {
      const told = this.several(counts, place);
      return told ? intervalOver(told) : interval(counts.right[place], counts.judged[place]);
    }

    // The share of right rows; of units with several, the mean over units of the share of each.
    accuracy(counts, place) {
      const told = this.several(counts, place);
      if (!told) return counts.judged[place] ? counts.right[place] / counts.judged[place] : null;
      const total = told.reduce((sum, [, , times]) => sum + times, 0);
      return told.reduce((sum, [right, of, times]) => sum + (times * right) / of, 0) / total;
    }

    // ---- what is chosen ----------------------------------------------------------------------------------------------

    showControls() {
      const state = this.state;
      const names = [["", "nothing"], ...this.axes.filter((axis) => axis.names && axis.name !== state.across && axis.name !== state.up).map((axis) => [axis.name, axis.name])];
      renewed(this.parts.options,
        choice("Colour", [["accuracy", "accuracy"], ["margin", "mean margin"], ["count", "configurations"]], state.measure, (measure) => this.change({ measure })),
        names.length > 1 ? choice("Side by side", names, state.by || "", (by) => this.change({ by: by || null, cell: null })) : "",
        this.parts.find,
        make("button", { type: "button", onclick: (event) => this.share(event.target) }, "Copy link to this view"),
      );
      if (this.parts.find.lastChild !== document.activeElement) this.parts.find.lastChild.value = state.find;
      const open = document.activeElement && document.activeElement.id;
      this.parts.controls.replaceChildren(...this.axes.map((axis, number) => this.control(axis, number)));
      if (open && document.getElementById(open)) document.getElementById(open).focus();
    }

    control(axis, number) {
      const state = this.state, fixed = state.fixed[axis.name];
      const role = axis.name === state.across ? ACROSS : axis.name === state.up ? UP : fixed !== undefined ? ONE : OVERALL;
      const id = `parameter-${number}`;
      const select = make("select", { id, "aria-label": `${axis.name}: how it is shown`, onchange: (event) => this.assign(axis.name, event.target.value) });
      for (const one of [ACROSS, UP, ONE, OVERALL]) select.append(make("option", { selected: one === role }, one));
      const parts = [make("label", { for: id }, named(axis.name, axis.unit)), select];
      if (role === ONE) {
        const full = (level) => (axis.full || axis.labels)[level], text = make("output", { title: full(fixed) }, axis.labels[fixed]);
        const range = make("input", { type: "range", id: `${id}-value`, min: 0, max: axis.labels.length - 1, value: fixed, "aria-label": `${axis.name}: value`, "aria-valuetext": axis.labels[fixed], oninput: (event) => {
          text.textContent = axis.labels[event.target.value];
          text.title = full(event.target.value);
          this.change({ fixed: { ...this.state.fixed, [axis.name]: Number(event.target.value) } });
        } });
        parts.push(make("span", { class: "value" }, range, text));
      }
      return make("div", { class: "parameter" }, ...parts);
    }

    // Exactly two parameters span the map: one that takes another's place gives it its own.
    assign(name, role) {
      const state = this.state, next = { across: state.across, up: state.up, fixed: { ...state.fixed }, cell: null, by: state.by };
      const free = this.axes.find((axis) => ![state.across, state.up].includes(axis.name));
      delete next.fixed[name];
      if (role === ACROSS || role === UP) {
        const key = role === ACROSS ? "across" : "up", other = role === ACROSS ? "up" : "across";
        if (next[other] === name) next[other] = next[key];
        next[key] = name;
        if (next.by === name) next.by = null;
      } else {
        for (const key of ["across", "up"]) if (next[key] === name) next[key] = free ? free.name : null;
        if (free && next.fixed[free.name] !== undefined && [next.across, next.up].includes(free.name)) delete next.fixed[free.name];
        if (role === ONE) next.fixed[name] = 0;
        if (next.across === null) [next.across, next.up] = [next.up, null];
      }
      this.change(next);
    }

    async share(button) {
      try {
        await navigator.clipboard.writeText(location.href);
        button.textContent = "Copied";
      } catch {
        prompt("The link to this view:", location.href);
      }
      setTimeout(() => { button.textContent = "Copy link to this view"; }, 1500);
    }

    // ---- the maps ----------------------------------------------------------------------------------------------------

    showMaps() {
      const state = this.state, single = { name: "", unit: "", labels: [""], level: new Uint8Array(this.table.count), names: true };
      const across = this.byName.get(state.across) || single, up = this.byName.get(state.up) || single, by = this.byName.get(state.by) || single;
      const counts = this.counted([by, up, across]);
      const values = Array.from(counts.all, (all, k) => (state.measure === "count" ? all : state.measure === "margin" ? (counts.margins[k] ? counts.margin[k] / counts.margins[k] : null) : this.accuracy(counts, k)));
      const finite = values.filter((value) => value !== null);
      const [low, high] = state.measure === "accuracy" ? [0, 1] : finite.length ? [Math.min(...finite), Math.max(...finite)] : [0, 1];
      // The darkest colour is the worst: the smallest accuracy, the smallest margin.
      const shade = (value) => (value - low) / (high - low || 1);
      const area = across.labels.length * up.labels.length, stop = [...(state.cell || [0, 0, 0])];
      this.cells = { across, up, by };
      clearTimeout(this.waits);
      this.peek(null); // it was a cell of other maps
      this.parts.maps.replaceChildren(...by.labels.map((label, part) => {
        const head = make("tr", {}, make("td", {}), ...across.labels.map((text, column) => make("th", { scope: "col", title: across.full && across.full[column] }, text)));
        const rows = up.labels.map((text, row) => make("tr", {}, make("th", { scope: "row", class: up.names && "names", title: up.full && up.full[row] }, text), ...across.labels.map((_, column) => {
          const place = part * area + row * across.labels.length + column;
          const cell = [part, row, column], value = values[place];
          const pinned = state.cell && state.cell.every((one, k) => one === cell[k]);
          const words = this.words(cell, counts, place, value);
          const written = value === null ? "" : state.measure === "accuracy" ? percentNumber(value) : short(Number(value.toPrecision(2)));
          return make("td", {}, make("button", { type: "button", class: value === null ? "cell none" : "cell", style: value === null ? {} : colour(shade(value)), "aria-label": words, "aria-pressed": pinned ? "true" : "false", tabindex: row === stop[1] && column === stop[2] ? 0 : -1, "data-cell": cell.join(",") }, written));
        })));
        rows.reverse();
        const table = make("table", { class: "map", style: { "min-width": `${6.2 + 2 * across.labels.length}rem` } }, make("thead", {}, head), make("tbody", {}, ...rows));
        const title = [state.by ? `${by.name} ${label}` : "", up.name ? `${named(up.name, up.unit)} against ${named(across.name, across.unit)}` : named(across.name, across.unit)].filter(Boolean).join(": ");
        return make("figure", { class: "map", style: { "flex-basis": `${7 + 2.1 * across.labels.length}rem` } }, make("figcaption", {}, title), make("div", { class: "scroll" }, table));
      }));
      this.listen();
      this.legend(low, high, shade);
      this.say();
    }

    words([part, row, column], counts, place, value) {
      const { across, up, by } = this.cells;
      const where = [[by, part], [up, row], [across, column]].filter(([axis]) => axis.name).map(([axis, level]) => `${axis.name} ${axis.labels[level]}`).join(", ");
      if (!counts.all[place]) return `${where}: no configuration`;
      const judged = counts.judged[place];
      const [low, high] = judged ? this.interval(counts, place) : [null, null];
      const margin = counts.margins[place] ? `, mean margin ${short(counts.margin[place] / counts.margins[place])}` : "";
      return `${where}: right in ${counts.right[place]} of ${judged} (${percent(this.accuracy(counts, place))}, ${percent(low)} to ${percent(high)})${margin}`;
    }

    listen() {
      const maps = this.parts.maps;
      const at = (event) => event.target.closest && event.target.closest("[data-cell]");
      const cell = (button) => button.dataset.cell.split(",").map(Number);
      maps.onclick = (event) => {
        const button = at(event);
        if (!button) return;
        const same = this.state.cell && this.state.cell.join(",") === button.dataset.cell;
        this.change({ cell: same ? null : cell(button) });
        const again = maps.querySelector(`[data-cell="${button.dataset.cell}"]`);
        if (again) again.focus({ preventScroll: true });
      };
      const look = (button) => {
        clearTimeout(this.waits);
        this.waits = setTimeout(() => this.peek(button), 60);
      };
      maps.onpointerover = (event) => { if (event.pointerType !== "touch" && at(event)) look(at(event)); };
      maps.onpointerleave = () => look(null);
      maps.onkeydown = (event) => {
        const button = at(event), step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 0], ArrowDown: [-1, 0] }[event.key];
        if (!button || !step) return;
        const [part, row, column] = cell(button);
        const next = maps.querySelector(`[data-cell="${part},${row + step[0]},${column + step[1]}"]`);
        event.preventDefault();
        if (!next) return;
        button.tabIndex = -1;
        next.tabIndex = 0;
        next.focus();
      };
    }

    // What is in a cell that is pointed at, beside it: its counts and its worst pictures.
    peek(button) {
      const place = this.parts.peek;
      place.hidden = !button;
      if (!button) return;
      const found = this.found(button.dataset.cell.split(",").map(Number), PEEKED).rows.filter((k) => this.address(k));
      place.replaceChildren(make("div", {}, button.getAttribute("aria-label")), make("div", { class: "gallery" }, ...found.map((k) => this.picture(k, ""))));
      const at = button.getBoundingClientRect(), mine = place.getBoundingClientRect(), gap = 8;
      const below = at.bottom + gap + mine.height <= innerHeight || at.top < mine.height + gap;
      place.style.left = `${Math.max(gap, Math.min(at.left + at.width / 2 - mine.width / 2, document.documentElement.clientWidth - mine.width - gap))}px`;
      place.style.top = `${below ? at.bottom + gap : at.top - gap - mine.height}px`;
    }

    say() {
      const cell = this.state.cell;
      const button = cell && this.parts.maps.querySelector(`[data-cell="${cell.join(",")}"]`);
      this.parts.status.textContent = button ? `${button.getAttribute("aria-label")}. Its pictures are below.` : `${this.number()} configurations. Point at a cell to see what is in it; choose it, and the pictures below are its own.`;
    }

    number() {
      if (!this.kept) return this.table.count.toLocaleString("en");
      let sum = 0;
      for (const one of this.kept) sum += one;
      return `${sum.toLocaleString("en")} of ${this.table.count.toLocaleString("en")}`;
    }

    legend(low, high, shade) {
      const steps = Array.from({ length: 9 }, (_, k) => low + ((high - low) * k) / 8);
      const unit = { accuracy: "accuracy in %", margin: "mean margin; below 0: wrong", count: "configurations" }[this.state.measure];
      const text = (value) => (this.state.measure === "accuracy" ? percentNumber(value) : short(Number(value.toPrecision(2))));
      this.parts.legend.replaceChildren(make("span", {}, unit), ...steps.map((value, k) => make("span", { class: "swatch", style: colour(shade(value)) }, k % 4 ? "" : text(value))));
    }

    // ---- along each parameter ----------------------------------------------------------------------------------------

    showAlong() {
      const by = this.byName.get(this.state.by) || null;
      const shown = this.axes.filter((axis) => this.state.fixed[axis.name] === undefined && axis !== by && axis.labels.length <= 200);
      this.parts.alongs.replaceChildren(...shown.map((axis) => this.along(axis, by)));
    }

    along(axis, by) {
      const parts = by ? by.labels : [""], counts = this.counted(by ? [by, axis] : [axis]);
      const wide = 420, high = 190, left = 48, bottom = 40, n = axis.labels.length;
      const x = (level, part) => left + ((level + 0.5 + (parts.length > 1 ? (part - (parts.length - 1) / 2) * Math.min(0.12, 0.7 / parts.length) : 0)) * (wide - left - 8)) / n;
      const y = (share) => 8 + (1 - share) * (high - bottom - 8);
      const marks = [], rows = [];
      for (const share of [0, 0.5, 1]) marks.push(drawn("line", { x1: left, x2: wide - 8, y1: y(share), y2: y(share), class: "rule" }), drawn("text", { x: left - 6, y: y(share) + 4, "text-anchor": "end" }, `${100 * share}\u00a0%`));
      const longest = Math.max(...axis.labels.map((text) => text.length)), room = 52; // letters beside each other
      const letters = axis.names ? Math.min(Math.max(Math.floor(room / n) - 1, 7), longest) : longest;
      const every = Math.ceil(n / Math.max(1, Math.floor(room / (letters + 1))));
      axis.labels.forEach((text, level) => {
        if (level % every === 0) marks.push(drawn("text", { x: x(level, (parts.length - 1) / 2), y: high - 24, "text-anchor": "middle" }, drawn("title", {}, (axis.full || axis.labels)[level]), cut(text, letters)));
      });
      marks.push(drawn("text", { x: (wide + left) / 2, y: high - 6, "text-anchor": "middle", class: "name" }, named(axis.name, axis.unit)));
      parts.forEach((part, series) => axis.labels.forEach((text, level) => {
        const place = series * n + level, judged = counts.judged[place];
        if (!judged) return;
        const share = this.accuracy(counts, place), [low, top] = this.interval(counts, place);
        const words = `${part ? `${part}, ` : ""}${text}: ${percent(share)}, ${percent(low)} to ${percent(top)}, of ${judged}`;
        const dot = shape(series, x(level, series), y(share));
        marks.push(drawn("g", { class: `series s${series % 6}` }, drawn("title", {}, words), drawn("line", { x1: x(level, series), x2: x(level, series), y1: y(low), y2: y(top) }), dot));
        rows.push(words);
      }));
      const picture = drawn("svg", { viewBox: `0 0 ${wide} ${high}`, class: "along", role: "img", "aria-label": `Accuracy along ${named(axis.name, axis.unit)}. ${rows.slice(0, 40).join("; ")}` }, ...marks);
      const key = by ? make("p", { class: "key" }, ...parts.map((part, series) => make("span", { class: `s${series % 6}` }, drawn("svg", { viewBox: "0 0 12 12", "aria-hidden": "true" }, shape(series, 6, 6)), ` ${part}`))) : null;
      return make("figure", {}, picture, ...(key ? [key] : []));
    }

    // ---- pictures ----------------------------------------------------------------------------------------------------

    // The first rows, of a cell or of all, in the order that is chosen, and how many there are.
    found(cell, most, inside = null) {
      const state = this.state, { across, up, by } = this.cells;
      const { right, margin, source } = this.table.columns, kept = this.kept, found = [];
      let all = 0;
      const sign = state.order === "best" ? 1 : -1, sorted = state.order.startsWith(BY) && this.table.parameters.find((one) => BY + one.name === state.order);
      const better = (a, b) => sign * (value(a) - value(b)) || b - a;
      const numbers = sorted ? sorted.data : margin;
      const value = (k) => (numbers[k] === numbers[k] ? numbers[k] : -sign * Infinity);
      for (let k = 0; k < this.table.count; k++) {
        if (kept && !kept[k]) continue;
        if (cell && (by.level[k] !== cell[0] || up.level[k] !== cell[1] || across.level[k] !== cell[2])) continue;
        if (inside && !inside(k)) continue;
        const others = this.beside(k);
        if (!cell && state.group !== "run" && others.some((other) => source[other] < source[k])) continue; // is shown with the first
        if (state.show === "differ" ? others.every((other) => right[other] === right[k]) : state.show !== "all" && ![k, ...others].some((row) => right[row] === (state.show === "right" ? 1 : 0))) continue;
        all += 1;
        if (found.length < most) {
          found.push(k);
          if (state.order !== "first" && found.length === most) found.sort((a, b) => better(b, a));
        } else if (state.order !== "first" && better(k, found[most - 1]) > 0) {
          let place = most - 1;
          while (place > 0 && better(k, found[place - 1]) > 0) {
            found[place] = found[place - 1];
            place -= 1;
          }
          found[place] = k;
        }
      }
      if (state.order !== "first") found.sort((a, b) => better(b, a));
      return { rows: found, all };
    }

    showGallery() {
      const state = this.state, { rows, all } = this.found(state.cell, SHOWN), boxes = rows.some((k) => this.address(k) && this.marks(k).length);
      const several = this.table.sources.length > 1;
      renewed(this.parts.bar,
        choice("Show", SHOWS.filter(([name]) => several || name !== "differ"), state.show, (show) => this.change({ show })),
        choice("First", [...ORDERS, ...this.numbers()], state.order, (order) => this.change({ order })),
        choice("Group by", this.groups(), state.group || "", (group) => this.change({ group: group || null })),
        make("span", { class: "soft" }, `${state.group ? "" : `${rows.length} of `}${all.toLocaleString("en")}${state.cell ? " in this cell" : ""}${state.find ? " found" : ""}`),
        boxes ? make("span", { class: "soft boxes" }, "Boxes: ", make("span", { class: "true" }, "where the object is"), ", ", make("span", { class: "said" }, "where the model says it is"), ", ", make("span", { class: "other" }, "what else it says")) : "",
        ...(state.cell ? [make("button", { type: "button", onclick: () => this.change({ cell: null }) }, "All cells")] : []),
      );
      const gallery = (found) => make("div", { class: "gallery" }, ...found.map((k, place) => this.card(k, () => this.details(found, place))));
      this.parts.gallery.replaceChildren(...(state.group ? this.grouped(gallery) : [gallery(rows)]));
    }

    // A gallery for each value of what is grouped by; the last ones, which have no room, are counted.
    grouped(gallery) {
      const { answer, outcome, right } = this.table.columns, name = this.state.group, axis = this.byName.get(name);
      const own = { verdict: { labels: ["wrong", "right", "not judged"], level: right }, outcome: { labels: this.table.outcomes, level: outcome } };
      const { labels, level } = axis || own[name] || { labels: this.table.answers, level: answer };
      const made = [];
      let shown = 0, left = 0;
      labels.forEach((label, group) => {
        if (shown >= MOST_GROUPS) {
          left += 1;
          return;
        }
        const { rows, all } = this.found(this.state.cell, name === DRIVE ? SHOWN : IN_A_GROUP, (k) => level[k] === group);
        if (!all) return;
        shown += 1;
        const counted = rows.length < all ? `${rows.length} of ${all.toLocaleString("en")}` : `${all}`;
        made.push(make("h3", {}, `${axis && !axis.names ? `${name} ` : ""}${name === DRIVE ? "Drive " : ""}${label || "no prediction"}`, make("span", { class: "soft" }, ` ${counted}`)), gallery(rows));
      });
      if (left) made.push(make("p", { class: "soft" }, `${left} further values are left out: search, or choose one value above.`));
      return made;
    }

    // The rows of the other runs that are of the same configuration: its number, and the same numbers.
    beside(k) {
      const { step, source } = this.table.columns;
      if (this.table.sources.length < 2) return [];
      if (!this.table.pairs) {
        this.table.pairs = new Map();
        for (let row = 0; row < this.table.count; row++) {
          if (!this.table.pairs.has(step[row])) this.table.pairs.set(step[row], []);
          this.table.pairs.get(step[row]).push(row);
        }
      }
      const same = (a, b) => this.table.parameters.every((one) => one.levels || one.data[a] === one.data[b] || Number.isNaN(one.data[a]) || Number.isNaN(one.data[b]));
      return this.table.pairs.get(step[k]).filter((row) => source[row] !== source[k] && same(row, k));
    }

    address(k) {
      const { step, source } = this.table.columns;
      return this.table.sources[source[k]].picture(step[k]);
    }

    // The boxes of a detector's prediction: a class and x, y, width, height in pixels of what it saw. All that are known
    // where they are `named`; else those that a small picture has room for.
    marks(k, named = false) {
      const { boxes, others, source } = this.table.columns;
      if (!boxes || !this.table.sources[source[k]].size) return [];
      const box = (name, from, at, label, score = null) => {
        const [x0, y0, x1, y1] = Array.from(from.subarray(at, at + 4), (x) => x / BOX_STEPS);
        return { name, label, score, x: x0, y: y0, width: x1 - x0, height: y1 - y0 };
      };
      const first = ["true", "said"].map((name, number) => box(name, boxes, 8 * k + 4 * number, "")).filter((one) => one.x < NO_BOX / BOX_STEPS);
      const found = [];
      for (let at = k ? others && others.ends[k - 1] : 0; others && at < others.ends[k]; at++) {
        const place = OF_A_BOX * at, told = others.list[place + 5], score = told === NO_PROBABILITY ? null : told / 10000;
        const one = box(score === null ? "true" : "other", others.list, place, this.table.things[others.list[place + 4]], score);
        const twin = first.find((other) => ["x", "y", "width", "height"].every((end) => other[end] === one[end]) && (other.name === "true") === (one.name === "true"));
        if (twin) Object.assign(twin, { label: twin.label || one.label, score: twin.score === null ? score : twin.score });
        else if (named || score === null || score >= SURE) found.push(one);
      }
      return [...found, ...first];
    }

    picture(k, alt, named = false) {
      const marks = this.marks(k, named), image = make("img", { src: this.address(k), alt, loading: "lazy" });
      if (!marks.length) return make("span", { class: "picture" }, image);
      const [high, wide] = this.table.sources[this.table.columns.source[k]].size;
      const letters = wide / 28;
      const written = [];
      const text = ({ name, label, score, x, y, height: tall }) => {
        const left = Math.max(0, x);
        let line = y > letters ? y - letters / 4 : Math.min(high, y + tall) - letters / 4;
        while (written.some(([other, at]) => Math.abs(other - left) < 9 * letters && Math.abs(at - line) < letters)) line += letters;
        written.push([left, line]);
        return drawn("text", { class: name, x: left, y: line, "font-size": letters }, score === null ? label : `${label} ${score.toFixed(2)}`);
      };
      const drawings = marks.map(({ name, x, y, width, height }) => drawn("rect", { class: name, x, y, width, height }));
      if (named) drawings.push(...marks.filter((one) => one.label).map(text));
      return make("span", { class: "picture" }, image, drawn("svg", { viewBox: `0 0 ${wide} ${high}`, "aria-hidden": "true" }, ...drawings));
    }

    // What was predicted, with its probability or score: of an object that was missed, the best score that did not count.
    predicted(k) {
      const { answer, outcome, probability, source } = this.table.columns, label = this.table.answers[answer[k]] || "no prediction";
      return said(this.table.sources[source[k]].task, label, probability[k] === NO_PROBABILITY ? null : probability[k] / 10000, this.table.outcomes[outcome[k]]);
    }

    card(k, open) {
      const { right, source } = this.table.columns, verdict = (row) => (right[row] === UNKNOWN ? "not judged" : right[row] ? "right" : "wrong");
      const mark = (row) => make("strong", {}, { wrong: "\u2717 ", right: "\u2713 " }[verdict(row)] || "");
      const others = this.beside(k), all = [k, ...others], here = (row) => (others.length ? `${this.table.sources[source[row]].name}: ` : "");
      const shown = all.filter((row) => this.address(row)).map((row) => this.picture(row, `${here(row)}${verdict(row)}: ${this.predicted(row)}`));
      return make("button", { type: "button", class: `card ${verdict(k).replace(" ", "-")}`, onclick: open },
        shown.length > 1 ? make("span", { class: "beside" }, ...shown) : shown[0] || null,
        ...all.map((row) => make("span", {}, mark(row), here(row), this.predicted(row))));
    }

    // The short names of a parameter's levels, which its axis has where it varies.
    named(parameter) {
      const axis = this.byName.get(parameter.name);
      return axis && axis.full === parameter.levels ? axis.labels : shortened(parameter.levels);
    }

    details(rows, first) {
      let place = first;
      const inside = make("div", {}), count = make("span", { class: "soft", role: "status" });
      const step = (by) => {
        place = (place + by + rows.length) % rows.length;
        show();
      };
      const button = (text, onclick) => make("button", { type: "button", onclick }, text);
      const dialog = make("dialog", {
        onclose: (event) => event.target.remove(),
        onclick: (event) => { if (event.target === dialog) dialog.close(); },
        onkeydown: (event) => { if (event.key === "ArrowLeft" || event.key === "ArrowRight") step(event.key === "ArrowLeft" ? -1 : 1); },
      });
      const show = () => {
        const k = rows[place], all = [k, ...this.beside(k)], { right, margin, step: number, source } = this.table.columns;
        const facts = [["run", (row) => this.table.sources[source[row]].name], ["configuration", (row) => String(number[row])], ["prediction", (row) => this.predicted(row)], ["verdict", (row) => ["wrong", "right", "not judged"][right[row]]], ["margin", (row) => short(Number(margin[row].toPrecision(4)))]];
        for (const one of this.table.parameters) facts.push([named(one.name, one.unit), (row) => (one.levels ? this.named(one)[one.data[row]] : short(one.data[row])), (row) => one.levels && one.levels[one.data[row]]]);
        dialog.setAttribute("aria-label", `Configuration ${number[k]}`);
        count.textContent = `${place + 1} of ${rows.length}`;
        inside.replaceChildren(
          make("div", { class: "beside" }, ...all.filter((row) => this.address(row)).map((row) => this.picture(row, `what the model saw${all.length > 1 ? ` in ${this.table.sources[source[row]].name}` : ""}`, true))),
          make("table", { class: "facts" }, make("tbody", {}, ...facts.map(([name, value, full]) => make("tr", {}, make("th", { scope: "row" }, name), ...all.map((row) => make("td", { title: full && full(row) }, value(row))))))));
      };
      dialog.append(make("p", { class: "options" }, button("Previous", () => step(-1)), button("Next", () => step(1)), count, button("Close", () => dialog.close())), inside);
      show();
      document.body.append(dialog);
      dialog.showModal();
    }
  }

  // A mark of its own for each series, for those who do not tell colours apart.
  function shape(series, x, y) {
    const r = 4;
    const paths = [`M${x - r},${y}a${r},${r} 0 1,0 ${2 * r},0a${r},${r} 0 1,0 ${-2 * r},0`, `M${x - r},${y - r}h${2 * r}v${2 * r}h${-2 * r}z`, `M${x},${y - r - 1}l${r + 1},${2 * r}h${-2 * r - 2}z`, `M${x},${y - r - 1}l${r + 1},${r + 1}l${-r - 1},${r + 1}l${-r - 1},${-r - 1}z`, `M${x - r},${y - r}l${2 * r},${2 * r}M${x + r},${y - r}l${-2 * r},${2 * r}`, `M${x - r},${y}h${2 * r}M${x},${y - r}v${2 * r}`];
    return drawn("path", { d: paths[series % paths.length], class: "dot" });
  }

  // ---- where rows come from ----------------------------------------------------------------------------------------

  async function embedded(id) {
    const text = document.getElementById(id).textContent.trim();
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return unpacked(await new Response(stream).arrayBuffer());
  }

  async function fetched(address) {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error((await answer.text()) || `the server answered ${answer.status}`);
    return unpacked(await answer.arrayBuffer());
  }

  async function explore(place) {
    const runs = JSON.parse(document.getElementById("runs").textContent);
    const table = new Table(), status = make("p", { class: "status", role: "status" }, "Reading the rows …");
    place.append(status);
    place.hidden = false;
    const body = make("div", {});
    place.append(body);
    const explorer = new Explorer(body, table);
    table.sources = runs.map((run) => ({ name: run.name, picture: pictures(run), task: run.task, size: run.size, grid: run.grid, drives: run.drives }));
    const renew = () => {
      for (const still of document.querySelectorAll("[data-still]")) still.hidden = true;
      explorer.renew();
    };
    const load = async (run, number) => {
      if (run.embedded) return table.add(await embedded(run.embedded), number);
      let last = 0;
      for (;;) {
        const part = await fetched(`${run.rows}${run.parts ? `?after=${last}` : ""}`);
        last = Math.max(last, part.head.last);
        if (part.head.count) table.add(part, number);
        if (!run.parts) return;
        if (part.head.count) renew();
        if (!part.head.more) {
          if (!part.head.running) return;
          status.textContent = "This sweep goes on; the page follows it.";
          await new Promise((done) => setTimeout(done, FOLLOW));
        }
      }
    };
    try {
      await Promise.all(runs.map(load));
      status.remove();
      if (table.count) renew();
    } catch (error) {
      status.textContent = `The rows can't be read: ${error.message}`;
    }
  }

  function pictures(run) {
    const given = run.pictures;
    if (!given) return () => null;
    if (given.embedded) return (step) => given.embedded[Math.floor(step / given.models)] || null;
    const kept = given.kept ? new Set(given.kept) : null;
    return (step) => {
      const number = Math.floor(step / given.models);
      if (kept && !kept.has(number)) return null;
      return `${given.folder}/${String(Math.floor(number / 1000)).padStart(4, "0")}/${number}.${given.suffix}`;
    };
  }

  const place = document.getElementById("explorer");
  if (place) explore(place);
})();
