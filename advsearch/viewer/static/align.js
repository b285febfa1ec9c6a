// The alignment page: a rendering over the camera's picture, and photographs that are sent to the server.
"use strict";
(() => {
  const SIDE = 1024; // longest side of a photograph, pixels
  const { key, names } = JSON.parse(document.getElementById("photographing").textContent);
  const place = document.getElementById("align");
  const asked = new URLSearchParams(location.search).get("rendering");
  let chosen = listed(asked || names[0]), at = 0, shape = [1, 1], image = null;

  const video = make("video", { playsinline: "", "aria-label": "what the camera sees" });
  video.muted = true;
  const over = make("canvas", { role: "img", "aria-label": "the rendering" });
  const context = over.getContext("2d", { willReadFrequently: true });
  const stage = make("div", { class: "camera" }, video, over);
  const wanted = make("input", { type: "text", id: "wanted", value: chosen.join(", "), autocomplete: "off", "aria-describedby": "renderings", onchange: choose });
  const look = make("select", { id: "look", onchange: draw }, ...["translucent", "edges only", "hidden"].map((text) => make("option", {}, text)));
  const opacity = make("input", { type: "range", id: "opacity", min: 0, max: 100, value: 50, oninput: fade });
  const camera = button("Open the camera", open), photo = button("Take a photograph", take);
  const before = button("Previous", () => step(-1)), after = button("Next", () => step(1));
  const file = make("input", { type: "file", id: "file", accept: "image/jpeg,image/png,image/webp", capture: "environment", onchange: pick });
  const status = make("p", { class: "status", role: "status" });
  photo.disabled = true;
  place.append(
    make("p", { class: "options" }, label("Renderings", wanted), label("Shown", look), label("Opacity", opacity)),
    stage, make("p", { class: "options" }, camera, photo, before, after), status,
    make("p", { class: "options" }, label("Or send a picture that you have", file)),
  );

  function button(text, onclick) { return make("button", { type: "button", onclick }, text); }
  function label(text, input) { return make("label", { for: input.id }, make("span", {}, text), input); }
  function listed(text) { return text.split(/[\s,]+/).filter(Boolean); }
  function address(name) { return `renderings/${encodeURIComponent(name)}`; }
  function say(text) { status.textContent = text; }

  function choose() {
    chosen = listed(wanted.value);
    at = 0;
    const query = new URLSearchParams({ rendering: chosen.join(",") });
    history.replaceState(null, "", `${location.pathname}?${query}`);
    show();
  }
  function step(by) {
    at = (at + by + chosen.length) % Math.max(chosen.length, 1);
    show();
  }
  async function show() {
    const name = chosen[at];
    before.disabled = after.disabled = chosen.length < 2;
    photo.disabled = true;
    image = null;
    context.clearRect(0, 0, over.width, over.height);
    if (name === undefined) return say("Name a rendering.");
    const found = new Image();
    found.src = address(name);
    try { await found.decode(); } catch { return say(`This run has no rendering called ${name}.`); }
    if (chosen[at] !== name) return;
    image = found;
    shape = [image.naturalWidth, image.naturalHeight];
    stage.style.aspectRatio = `${shape[0]} / ${shape[1]}`;
    over.setAttribute("aria-label", `rendering ${name}`);
    photo.disabled = !video.srcObject;
    draw();
    say(`Rendering ${name}${chosen.length > 1 ? `, ${at + 1} of ${chosen.length}` : ""}.`);
  }
  function draw() {
    over.hidden = look.value === "hidden";
    if (!image) return;
    [over.width, over.height] = shape;
    context.drawImage(image, 0, 0);
    if (look.value === "edges only") context.putImageData(edges(context.getImageData(0, 0, ...shape)), 0, 0);
    fade();
  }
  function fade() { over.style.opacity = String(opacity.value / 100); }

  // Sobel's filter of the brightness: light lines, as opaque as the brightness changes.
  function edges(given) {
    const { width, height, data } = given, grey = new Float32Array(width * height), lines = new ImageData(width, height);
    for (let k = 0; k < grey.length; k++) grey[k] = 0.299 * data[4 * k] + 0.587 * data[4 * k + 1] + 0.114 * data[4 * k + 2];
    for (let y = 1; y < height - 1; y++) {
      for (let x = 1; x < width - 1; x++) {
        const k = y * width + x, w = width;
        const across = grey[k - w + 1] + 2 * grey[k + 1] + grey[k + w + 1] - grey[k - w - 1] - 2 * grey[k - 1] - grey[k + w - 1];
        const down = grey[k + w - 1] + 2 * grey[k + w] + grey[k + w + 1] - grey[k - w - 1] - 2 * grey[k - w] - grey[k - w + 1];
        const strength = Math.hypot(across, down);
        lines.data.set([0, 255, 255, strength < 40 ? 0 : Math.min(255, 2 * strength)], 4 * k);
      }
    }
    return lines;
  }

  async function open() {
    if (!navigator.mediaDevices) return say("A browser opens a camera over HTTPS only: advsearch dashboard --https, or --host, gives that.");
    try {
      const wish = { facingMode: { ideal: "environment" }, width: { ideal: 1920 }, height: { ideal: 1080 } };
      video.srcObject = await navigator.mediaDevices.getUserMedia({ video: wish, audio: false });
      await video.play();
    } catch (error) { return say(`The camera did not open: ${error.message || error.name}.`); }
    camera.hidden = true;
    photo.disabled = !image;
    say("The camera is open.");
  }
  // What stands under the rendering: the middle of the camera's picture, in the rendering's shape.
  function take() {
    const [width, height] = [video.videoWidth, video.videoHeight], ratio = shape[0] / shape[1];
    const part = width / height > ratio ? [height * ratio, height] : [width, width / ratio];
    const shrink = Math.min(1, SIDE / Math.max(...part));
    const canvas = make("canvas");
    [canvas.width, canvas.height] = part.map((side) => Math.max(1, Math.round(side * shrink)));
    canvas.getContext("2d").drawImage(video, (width - part[0]) / 2, (height - part[1]) / 2, ...part, 0, 0, canvas.width, canvas.height);
    canvas.toBlob(send, "image/jpeg", 0.95);
  }
  function pick() {
    if (file.files.length && image) send(file.files[0]);
    file.value = "";
  }
  async function send(data) {
    photo.disabled = true;
    say("The photograph is being judged; the first one waits for the model.");
    try {
      const answer = await fetch(address(chosen[at]), { method: "POST", body: data, headers: { "X-Advsearch-Key": key } });
      if (!answer.ok) throw new Error(await answer.text());
      document.getElementById("agreement").innerHTML = (await answer.json()).table;
      say("The photograph is kept; the table below counts it.");
    } catch (error) { say(`It was not taken: ${error.message}`); }
    photo.disabled = !(image && video.srcObject);
  }
  show();
})();
