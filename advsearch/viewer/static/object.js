// An object to turn, drawn with WebGL 2 from a glTF binary: by mouse, finger, wheel and keys; nothing moves by itself.
"use strict";
(() => {
  const place = document.getElementById("object");
  if (!place) return;
  const STEP = 10, ZOOM = 1.15, NEAREST = 0.45, FARTHEST = 4, STEEPEST = 89; // degrees a key, factor a key, distances, degrees
  const VERTEX = `#version 300 es
    in vec3 position; in vec3 normal; in vec2 uv;
    uniform mat4 view;
    out vec3 facing; out vec3 where_; out vec2 at;
    void main() {
      facing = normal; where_ = position; at = uv;
      gl_Position = view * vec4(position, 1.0);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 facing; in vec3 where_; in vec2 at;
    uniform sampler2D image; uniform vec3 eye;
    out vec4 colour;
    void main() { // light from above and, weaker, from where one looks; linear, then as sRGB
      vec3 n = normalize(facing), towards = normalize(eye - where_);
      if (dot(n, towards) < 0.0) n = -n;
      float light = 0.45 + 0.25 * n.y + 0.4 * max(dot(n, towards), 0.0);
      vec3 linear = min(texture(image, at).rgb * light, 1.0);
      colour = vec4(mix(1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308))), 1.0);
    }`;

  // ---- 4 x 4 matrices, column by column ----------------------------------------------------------------------------

  const product = (a, b) => a.map((_, i) => [0, 1, 2, 3].reduce((sum, k) => sum + a[k * 4 + (i % 4)] * b[(i >> 2) * 4 + k], 0));
  const minus = (a, b) => a.map((one, i) => one - b[i]);
  const dot = (a, b) => a.reduce((sum, one, i) => sum + one * b[i], 0);
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => a.map((one) => one / (Math.hypot(...a) || 1));

  function looking(eye, middle, fov, aspect, near, far) { // the field of view is that of the shorter side
    const z = unit(minus(eye, middle)), x = unit(cross([0, 1, 0], z)), y = cross(z, x), f = 1 / Math.tan(fov / 2);
    const view = [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
    const depth = [(far + near) / (near - far), (2 * far * near) / (near - far)];
    return product([f / Math.max(aspect, 1), 0, 0, 0, 0, f * Math.min(aspect, 1), 0, 0, 0, 0, depth[0], -1, 0, 0, depth[1], 0], view);
  }

  // ---- the file ----------------------------------------------------------------------------------------------------

  function read(text) {
    const bytes = Uint8Array.from(atob(text), (one) => one.charCodeAt(0)), numbers = new DataView(bytes.buffer);
    const length = numbers.getUint32(12, true), file = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + length)));
    const begin = 28 + length;
    file.bytes = (view) => { const { byteOffset = 0, byteLength } = file.bufferViews[view]; return bytes.slice(begin + byteOffset, begin + byteOffset + byteLength); };
    return file;
  }

  // ---- drawing -----------------------------------------------------------------------------------------------------

  function compiled(gl) {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    ["position", "normal", "uv"].forEach((name, number) => gl.bindAttribLocation(program, number, name));
    gl.linkProgram(program);
    return gl.getProgramParameter(program, gl.LINK_STATUS) ? program : null;
  }

  async function uploaded(gl, file) { // every mesh and texture once
    const textures = await Promise.all((file.images || []).map(async (image) => {
      const picture = await createImageBitmap(new Blob([file.bytes(image.bufferView)], { type: image.mimeType }));
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
      gl.generateMipmap(gl.TEXTURE_2D);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
      return texture;
    }));
    const meshes = file.meshes.map(({ primitives: [one] }) => {
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      ["POSITION", "NORMAL", "TEXCOORD_0"].forEach((name, number) => {
        const accessor = file.accessors[one.attributes[name]];
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, file.bytes(accessor.bufferView), gl.STATIC_DRAW);
        gl.enableVertexAttribArray(number);
        gl.vertexAttribPointer(number, accessor.type === "VEC2" ? 2 : 3, accessor.componentType, false, 0, 0);
      });
      const faces = file.accessors[one.indices], { min, max } = file.accessors[one.attributes.POSITION];
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, file.bytes(faces.bufferView), gl.STATIC_DRAW);
      const texture = file.materials[one.material].pbrMetallicRoughness.baseColorTexture.index;
      return { array, count: faces.count, kind: faces.componentType, texture: textures[file.textures[texture].source], min, max };
    });
    return file.scenes.map((scene) => scene.nodes.map((node) => file.nodes[node]).filter((node) => node.mesh !== undefined).map((node) => meshes[node.mesh]));
  }

  function bounds(meshes) {
    const ends = [0, 1, 2].map((axis) => [Math.min(...meshes.map((one) => one.min[axis])), Math.max(...meshes.map((one) => one.max[axis]))]);
    return { middle: ends.map(([low, high]) => (low + high) / 2), radius: Math.hypot(...ends.map(([low, high]) => high - low)) / 2 };
  }

  async function begin() {
    const canvas = make("canvas", { tabindex: 0, role: "application", "aria-label": "the object: arrow keys turn it, plus and minus zoom, Home goes back" });
    const status = make("p", { class: "soft", role: "status" });
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: false, preserveDrawingBuffer: true });
    const program = gl && compiled(gl);
    if (!program) {
      place.append(make("p", { class: "soft" }, "This browser has no WebGL 2, which turns the object; the pictures above show it."));
      place.closest("[hidden]").hidden = false;
      return;
    }
    const file = read(JSON.parse(document.getElementById("object-file").textContent)), scenes = await uploaded(gl, file);
    const { middle, radius } = bounds(scenes[0]), from = minus(file.nodes.find((node) => node.camera !== undefined).matrix.slice(12, 15), middle);
    const degrees = (radians) => (radians * 180) / Math.PI, radians = (given) => (given * Math.PI) / 180;
    const home = { turn: degrees(Math.atan2(from[0], from[2])), tilt: degrees(Math.asin(unit(from)[1])), distance: 1 };
    let now = { ...home }, shown = 0, waiting = false;
    const at = (name) => gl.getUniformLocation(program, name);

    function draw() {
      waiting = false;
      const scale = Math.min(window.devicePixelRatio || 1, 2), [width, height] = [canvas.clientWidth, canvas.clientHeight].map((one) => Math.max(Math.round(one * scale), 1));
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      const away = 3.1 * radius * now.distance, [turn, tilt] = [radians(now.turn), radians(now.tilt)];
      const eye = [Math.sin(turn) * Math.cos(tilt), Math.sin(tilt), Math.cos(turn) * Math.cos(tilt)].map((one, axis) => middle[axis] + one * away);
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.useProgram(program);
      gl.uniformMatrix4fv(at("view"), false, looking(eye, middle, radians(40), width / height, Math.max(away - 1.5 * radius, 0.02 * radius), away + 1.5 * radius));
      gl.uniform3fv(at("eye"), eye);
      for (const { array, count, kind, texture } of scenes[shown]) {
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.bindVertexArray(array);
        gl.drawElements(gl.TRIANGLES, count, kind, 0);
      }
    }
    function again() {
      if (!waiting) requestAnimationFrame(draw);
      waiting = true;
    }
    function to(change, told = true) {
      now = { ...now, ...change };
      now.tilt = Math.min(Math.max(now.tilt, -STEEPEST), STEEPEST);
      now.distance = Math.min(Math.max(now.distance, NEAREST), FARTHEST);
      const turned = Math.round((((now.turn - home.turn) % 360) + 540) % 360 - 180), tilt = Math.round(now.tilt);
      if (told) status.textContent = `turned by ${turned}°, seen from ${Math.abs(tilt)}° ${tilt < 0 ? "below" : "above"}`;
      again();
    }
    const keys = {
      ArrowLeft: () => ({ turn: now.turn - STEP }), ArrowRight: () => ({ turn: now.turn + STEP }),
      ArrowUp: () => ({ tilt: now.tilt + STEP }), ArrowDown: () => ({ tilt: now.tilt - STEP }),
      "+": () => ({ distance: now.distance / ZOOM }), "=": () => ({ distance: now.distance / ZOOM }), "-": () => ({ distance: now.distance * ZOOM }), Home: () => home,
    };
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      to(keys[event.key]());
    });
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); canvas.focus(); });
    canvas.addEventListener("pointermove", (event) => {
      if (canvas.hasPointerCapture(event.pointerId)) to({ turn: now.turn - 0.5 * event.movementX, tilt: now.tilt + 0.5 * event.movementY }, false);
    });
    canvas.addEventListener("pointerup", () => to({}));
    canvas.addEventListener("wheel", (event) => { // the page scrolls unless the object was chosen before
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      to({ distance: now.distance * ZOOM ** Math.sign(event.deltaY) });
    }, { passive: false });
    new ResizeObserver(again).observe(canvas);

    const buttons = ["Adversarial", "Clean"].map((name, number) => make("button", { type: "button", "aria-pressed": String(number === 0), onclick: () => choose(number) }, name));
    function choose(number) {
      shown = number;
      buttons.forEach((one, each) => one.setAttribute("aria-pressed", String(each === number)));
      again();
    }
    place.append(canvas, make("p", { class: "options" }, ...buttons, make("button", { type: "button", onclick: () => to(home) }, "As in the picture")), status);
    place.closest("[hidden]").hidden = false;
    draw();
  }

  begin().catch(() => {}); // a damaged file: the pictures stand alone
})();
