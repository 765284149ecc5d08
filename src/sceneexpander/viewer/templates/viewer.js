"use strict";
// Axes as everywhere in the project: x right, y down, z forward. All methods are drawn in the frame of the main one.
const facts = JSON.parse(document.getElementById("facts").textContent);
const $ = (id) => document.getElementById(id);
const canvas = $("scene");
const MIN_ALPHA = 1 / 255, MAX_ALPHA = 0.99, BLUR = 0.3, LEAST_COMPENSATION = 0.005, NEAR = 0.01, MARGIN = 0.15;  // of the project's rasteriser
const TEXELS = 1024;  // width of the data texture, two texels per splat
const CAPTURED = [0.38, 0.74, 0.76], GENERATED = [1.0, 0.61, 0.32];

const SPLAT_VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D splats;
uniform mat3 turn;        // camera from method, with the method's scale
uniform vec3 shift;
uniform vec4 lens;        // fx, fy, cx, cy
uniform vec2 size;
uniform vec4 tint;        // colour, strength
uniform float opacity;
uniform vec2 logScale;    // of byte 0, of byte 255
uniform bool compensate;  // opacities for the blur
layout(location = 0) in uint index;
out vec2 offset;          // standard deviations from the centre
flat out vec4 shade;
vec4 unit(uint word) {
  uint largest = word >> 30;
  vec3 other = (vec3(float((word >> 20) & 1023u), float((word >> 10) & 1023u), float(word & 1023u)) / 1023.0 - 0.5) * 1.4142135623730951;
  float rest = sqrt(max(0.0, 1.0 - dot(other, other)));
  if (largest == 0u) return vec4(rest, other);
  if (largest == 1u) return vec4(other.x, rest, other.yz);
  if (largest == 2u) return vec4(other.xy, rest, other.z);
  return vec4(other, rest);
}
mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w),
              2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w),
              2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y));
}
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  int at = int(index) * 2;
  uvec4 place = texelFetch(splats, ivec2(at % ${TEXELS}, at / ${TEXELS}), 0);
  uvec4 form = texelFetch(splats, ivec2((at + 1) % ${TEXELS}, (at + 1) / ${TEXELS}), 0);
  vec3 p = turn * uintBitsToFloat(place.xyz) + shift;
  float a = opacity * float(place.w >> 24) / 255.0;
  if (p.z <= ${NEAR}) return;
  vec2 low = -(lens.zw + ${MARGIN} * size) / lens.xy, high = (size - lens.zw + ${MARGIN} * size) / lens.xy;
  vec2 ratio = p.xy / p.z, held = clamp(ratio, low, high);
  vec3 bytes = vec3(float(form.y & 255u), float((form.y >> 8) & 255u), float((form.y >> 16) & 255u)) / 255.0;
  vec3 scale = exp(logScale.x + bytes * (logScale.y - logScale.x));
  mat3 axes = turn * rotation(unit(form.x));
  vec3 sx = vec3(0.0), sy = vec3(0.0);
  for (int i = 0; i < 3; i++) {
    vec3 axis = axes[i] * scale[i];
    sx[i] = lens.x * (axis.x - held.x * axis.z) / p.z;
    sy[i] = lens.y * (axis.y - held.y * axis.z) / p.z;
  }
  float xx = dot(sx, sx) + ${BLUR}, xy = dot(sx, sy), yy = dot(sy, sy) + ${BLUR};
  if (compensate) {
    vec3 area = cross(sx, sy);  // its square is the determinant before the blur
    a *= max(${LEAST_COMPENSATION}, sqrt(dot(area, area) / (xx * yy - xy * xy)));
  }
  if (a < ${MIN_ALPHA}) return;
  float middle = 0.5 * (xx + yy), apart = sqrt(max(0.0, 0.25 * (xx - yy) * (xx - yy) + xy * xy));
  vec2 first = abs(xy) > 1e-6 ? normalize(vec2(xy, middle + apart - xx)) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  vec2 spread = sqrt(vec2(middle + apart, max(middle - apart, 0.01)));
  float reach = sqrt(2.0 * log(a * 255.0) + 1e-4);
  offset = reach * vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID >> 1) * 2 - 1);
  vec2 pixel = lens.xy * ratio + lens.zw + offset.x * spread.x * first + offset.y * spread.y * vec2(-first.y, first.x);
  vec3 colour = vec3(float(place.w & 255u), float((place.w >> 8) & 255u), float((place.w >> 16) & 255u)) / 255.0;
  if ((form.y >> 24) != 0u) colour = mix(colour, tint.rgb, tint.a);
  shade = vec4(colour, a);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}`;
const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec4 shade;
out vec4 colour;
void main() {
  float alpha = min(shade.a * exp(-0.5 * dot(offset, offset)), ${MAX_ALPHA});
  if (alpha < ${MIN_ALPHA}) discard;
  colour = vec4(shade.rgb * alpha, alpha);
}`;
const FRAME_VERTEX = `#version 300 es
precision highp float;
uniform mat3 turn; uniform vec3 shift; uniform vec4 lens; uniform vec2 size;
layout(location = 0) in vec3 corner;
layout(location = 1) in vec2 place;
out vec2 at;
void main() {
  vec3 p = turn * corner + shift;
  at = place;
  // Homogeneous, so that lines are clipped at the near plane instead of turning over.
  gl_Position = vec4((2.0 * (lens.x * p.x + lens.z * p.z) / size.x) - p.z, p.z - 2.0 * (lens.y * p.y + lens.w * p.z) / size.y, p.z - ${2 * NEAR}, p.z);
}`;
const FRAME_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture; uniform vec4 paint; uniform float share;
in vec2 at;
out vec4 colour;
void main() {
  vec4 c = vec4(mix(paint.rgb, texture(picture, at).rgb, share), paint.a);
  colour = vec4(c.rgb * c.a, c.a);
}`;

const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
const state = { method: facts.methods[facts.methods.length - 1], view: 0, tint: false, frusta: true, share: 1, opacity: 1, moving: false, slow: false };
let pose = null;   // eye, axes right, down, forward, the lens of the view it came from, distance to what one turns around
let waiting = false, drawn = 0;

const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unitOf = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
const turned = (v, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add([v[0] * c, v[1] * c, v[2] * c], cross(axis, v), s), axis, dot(axis, v) * (1 - c));
};

function fail(text) {
  $("problem").textContent = text;
  $("problem").hidden = false;
  document.documentElement.dataset.state = "failed";
}

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(made, i).name;
    places[name] = gl.getUniformLocation(made, name);
  }
  return { made, places };
}

function texture(unitNumber) {
  const made = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unitNumber);
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, wrap, gl.CLAMP_TO_EDGE);
  return made;
}

async function unpack(method) {
  const text = $(`splats-${method.name}`).textContent;
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const raw = await new Response(stream).arrayBuffer();
  const n = method.count, view = new DataView(raw), bytes = new Uint8Array(raw, 10 * n);
  const rows = Math.max(1, Math.ceil(2 * n / TEXELS));
  const words = new Uint32Array(rows * TEXELS * 4), floats = new Float32Array(words.buffer);
  const means = new Float32Array(3 * n);
  for (let i = 0; i < n; i++) {
    for (let axis = 0; axis < 3; axis++) {
      const u = view.getUint16(4 * n + 2 * (axis * n + i), true) / 65535 * 2 - 1;
      const x = u * method.reach / (1 - Math.abs(u)) + method.origin[axis];
      means[3 * i + axis] = x;
      floats[8 * i + axis] = x;
    }
    const byte = (column) => bytes[column * n + i];
    words[8 * i + 3] = (byte(3) | byte(4) << 8 | byte(5) << 16 | byte(6) << 24) >>> 0;
    words[8 * i + 4] = view.getUint32(4 * i, true);
    words[8 * i + 5] = (byte(0) | byte(1) << 8 | byte(2) << 16 | byte(7) << 24) >>> 0;
  }
  method.texture = texture(0);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXELS, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
  method.means = means;
}

// Indices of the first `count` splats from far to near, by counting on 16 bits of the logarithm of depth.
const counts = new Uint32Array(65537);
function farToNear(means, count, row, offset) {
  const keys = new Int32Array(count);
  const low = Math.log(NEAR), scale = 65534 / (Math.log(1e5) - low);
  counts.fill(0);
  for (let i = 0; i < count; i++) {
    const z = row[0] * means[3 * i] + row[1] * means[3 * i + 1] + row[2] * means[3 * i + 2] + offset;
    const key = z > NEAR ? 65535 - Math.min(65534, ((Math.log(z) - low) * scale) | 0) : -1;
    keys[i] = key;
    if (key >= 0) counts[key + 1]++;
  }
  for (let k = 0; k < 65536; k++) counts[k + 1] += counts[k];
  const order = new Uint32Array(counts[65536]);
  for (let i = 0; i < count; i++) if (keys[i] >= 0) order[counts[keys[i]]++] = i;
  return order;
}

let splatProgram, frameProgram, orderBuffer, splatArray, frameBuffer, frameArray;
function prepare() {
  splatProgram = program(SPLAT_VERTEX, SPLAT_FRAGMENT);
  frameProgram = program(FRAME_VERTEX, FRAME_FRAGMENT);
  splatArray = gl.createVertexArray();
  gl.bindVertexArray(splatArray);
  orderBuffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  frameArray = gl.createVertexArray();
  gl.bindVertexArray(frameArray);
  frameBuffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, frameBuffer);
  for (const [at, numbers, start] of [[0, 3, 0], [1, 2, 12]]) {
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, numbers, gl.FLOAT, false, 20, start);
  }
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  const white = texture(1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4).fill(255));
  for (const [id, address] of Object.entries(facts.pictures)) {
    facts.pictures[id] = { texture: white, known: false };
    const image = new Image();
    image.onload = () => {
      const made = texture(1);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
      facts.pictures[id] = { texture: made, known: true };
      redraw();
    };
    image.src = address;
  }
}

// The lens of the view in pixels of the canvas: the whole view fits into it.
function lensOnCanvas() {
  const scale = Math.min(canvas.width / pose.width, canvas.height / pose.height);
  const [fx, fy, cx, cy] = pose.lens;
  return [fx * scale, fy * scale, canvas.width / 2 + (cx - pose.width / 2) * scale, canvas.height / 2 + (cy - pose.height / 2) * scale];
}

function draw() {
  waiting = false;
  const method = state.method;
  if (!method.means || !pose) return;
  const sharpness = Math.min(devicePixelRatio || 1, 2) * (state.moving && state.slow ? 0.5 : 1);
  const width = Math.max(1, Math.round(innerWidth * sharpness)), height = Math.max(1, Math.round(innerHeight * sharpness));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const started = performance.now();
  gl.viewport(0, 0, width, height);
  gl.clearColor(facts.background, facts.background, facts.background, 1);
  gl.clear(gl.COLOR_BUFFER_BIT);
  const lens = lensOnCanvas(), rows = [pose.right, pose.down, pose.forward];
  const shift = rows.map((row) => -dot(row, pose.eye));
  drawSplats(method, lens, rows, shift, [width, height]);
  if (state.frusta) drawFrames(method, lens, rows, shift, [width, height]);
  const pixel = new Uint8Array(4);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);  // waits for the picture: only so is its time known
  state.slow = performance.now() - started > (state.slow ? 20 : 60);
  drawn += 1;
  document.documentElement.dataset.drawn = String(drawn);
}

function drawSplats(method, lens, rows, shift, size) {
  const { scale, rotation, translation } = method.main_from_method;
  const turn = rows.map((row) => [0, 1, 2].map((j) => scale * (row[0] * rotation[0][j] + row[1] * rotation[1][j] + row[2] * rotation[2][j])));
  const offset = rows.map((row, i) => dot(row, translation) + shift[i]);
  const order = farToNear(method.means, Math.ceil(method.count * state.share), turn[2], offset[2]);
  const { made, places } = splatProgram;
  gl.useProgram(made);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, method.texture);
  gl.uniform1i(places.splats, 0);
  gl.uniformMatrix3fv(places.turn, true, turn.flat());
  gl.uniform3fv(places.shift, offset);
  gl.uniform4fv(places.lens, lens);
  gl.uniform2fv(places.size, size);
  gl.uniform4fv(places.tint, [...facts.tint.slice(0, 3), state.tint ? facts.tint[3] : 0]);
  gl.uniform1f(places.opacity, state.opacity);
  gl.uniform2fv(places.logScale, method.log_scale);
  gl.uniform1i(places.compensate, method.antialiased ? 1 : 0);
  gl.bindVertexArray(splatArray);
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
}

function drawFrames(method, lens, rows, shift, size) {
  const { made, places } = frameProgram;
  gl.useProgram(made);
  gl.activeTexture(gl.TEXTURE1);
  gl.uniform1i(places.picture, 1);
  gl.uniformMatrix3fv(places.turn, true, rows.flat());
  gl.uniform3fv(places.shift, shift);
  gl.uniform4fv(places.lens, lens);
  gl.uniform2fv(places.size, size);
  gl.bindVertexArray(frameArray);
  gl.bindBuffer(gl.ARRAY_BUFFER, frameBuffer);
  const length = facts.frustum;
  const centre = (view) => [0, 1, 2].map((i) => view.world_from_cam[i][3]);
  const away = (view) => Math.hypot(...add(centre(view), pose.eye, -1));
  // One does not look at a camera from inside it.
  const seen = method.views.filter((view) => view.posed && away(view) > 1.2 * length).sort((a, b) => away(b) - away(a));
  for (const view of seen) {
    const [fx, fy, cx, cy] = view.intrinsics;
    const world = (u, v) => {
      const ray = [(u * method.width - cx) / fx * length, (v * method.height - cy) / fy * length, length];
      return [0, 1, 2].map((i) => dot(view.world_from_cam[i], ray) + view.world_from_cam[i][3]);
    };
    const spots = [[0, 0], [1, 0], [0, 1], [1, 1]], corners = spots.map(([u, v]) => world(u, v));
    const eye = centre(view), picture = facts.pictures[view.id];
    const rim = [0, 1, 1, 3, 3, 2, 2, 0].map((i) => corners[i]);
    const vertices = corners.map((p, i) => [...p, ...spots[i]]);
    vertices.push(...corners.flatMap((p) => [eye, p]).concat(rim).map((p) => [...p, 0, 0]));
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices.flat()), gl.DYNAMIC_DRAW);
    const paint = view.generated ? GENERATED : CAPTURED;
    if (picture && picture.known) {
      gl.bindTexture(gl.TEXTURE_2D, picture.texture);
      gl.uniform1f(places.share, 1);
      gl.uniform4fv(places.paint, [...paint, 0.85]);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
    gl.uniform1f(places.share, 0);
    gl.uniform4fv(places.paint, [...paint, 1]);
    gl.drawArrays(gl.LINES, 4, vertices.length - 4);
  }
}

function redraw() {
  if (!waiting) { waiting = true; requestAnimationFrame(draw); }
}

function stand(index) {
  const views = state.method.views;
  state.view = ((index % views.length) + views.length) % views.length;
  const view = views[state.view], m = view.world_from_cam;
  const column = (j) => [m[0][j], m[1][j], m[2][j]];
  pose = { right: column(0), down: column(1), forward: column(2), eye: column(3), lens: view.intrinsics, width: state.method.width, height: state.method.height, distance: view.focus };
  $("view").textContent = view.generated ? `${view.id} (generated)` : view.id;
  $("view").className = view.generated ? "generated" : "";
  redraw();
}

async function show(method) {
  state.method = method;
  for (const button of $("methods").children) button.setAttribute("aria-selected", String(button.dataset.method === method.name));
  if (!method.means) await unpack(method);
  say();
  redraw();
}

function say() {
  const method = state.method, number = (n) => n.toLocaleString("en");
  const shown = Math.ceil(method.count * state.share);
  const dropped = method.total - shown;
  $("count").textContent = `${number(shown)} of ${number(method.total)} Gaussians` +
    (dropped ? `; the ${number(dropped)} left out weigh least in the method's own views` : "") +
    (dropped && shown === method.count ? ` (${Math.floor(method.worst_view_db)} dB or better against all of them)` : "") + ". Colours do not change with direction.";
}

function orbit(dx, dy) {
  const centre = add(pose.eye, pose.forward, pose.distance);
  const steep = dot(pose.forward, facts.up);
  if ((steep > 0.97 && dy > 0) || (steep < -0.97 && dy < 0)) dy = 0;
  const turn = (v) => turned(turned(v, pose.right, dy), facts.up, -dx);
  [pose.right, pose.down, pose.forward] = [turn(pose.right), turn(pose.down), turn(pose.forward)];
  pose.forward = unitOf(pose.forward);
  pose.right = unitOf(cross(pose.down, pose.forward));
  pose.down = cross(pose.forward, pose.right);
  pose.eye = add(centre, pose.forward, -pose.distance);
}

function pan(dx, dy) {
  const lens = lensOnCanvas(), step = pose.distance * (canvas.width / innerWidth);
  pose.eye = add(add(pose.eye, pose.right, -dx * step / lens[0]), pose.down, -dy * step / lens[1]);
}

function approach(factor) {
  const distance = Math.max(pose.distance * factor, facts.frustum * 0.2);
  pose.eye = add(pose.eye, pose.forward, pose.distance - distance);
  pose.distance = distance;
}

let settled = 0;
function moved() {
  state.moving = true;
  $("view").textContent = "free";
  $("view").className = "";
  redraw();
  clearTimeout(settled);
  settled = setTimeout(() => { state.moving = false; redraw(); }, 200);
}

function listen() {
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, [event.clientX, event.clientY]); });
  const lift = (event) => fingers.delete(event.pointerId);
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before || !pose) return;
    const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
    if (fingers.size === 1) {
      if (event.shiftKey || event.buttons & 6) pan(dx, dy); else orbit(dx * 0.006, dy * 0.006);
    } else {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const gap = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
      approach(gap(before) / gap(now));
      pan(dx / 2, dy / 2);
    }
    fingers.set(event.pointerId, now);
    moved();
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); if (pose) { approach(Math.exp(Math.max(-1, Math.min(1, event.deltaY * 0.0012)))); moved(); } }, { passive: false });
  addEventListener("resize", redraw);
  const compare = () => {
    const list = facts.methods, at = list.indexOf(state.method);
    if (list.length > 1) show(list[at === list.length - 1 ? at - 1 : list.length - 1]);
  };
  $("compare").hidden = facts.methods.length < 2;
  $("compare").addEventListener("click", compare);
  $("previous").addEventListener("click", () => stand(state.view - 1));
  $("next").addEventListener("click", () => stand(state.view + 1));
  $("home").addEventListener("click", () => stand(0));
  for (const name of ["tint", "frusta"]) $(name).addEventListener("change", (event) => { state[name] = event.target.checked; redraw(); });
  for (const name of ["share", "opacity"]) $(name).addEventListener("input", (event) => { state[name] = Number(event.target.value); say(); redraw(); });
  addEventListener("keydown", (event) => {
    if (event.target instanceof HTMLInputElement) return;
    const act = { b: compare, r: () => stand(0), ArrowLeft: () => stand(state.view - 1), ArrowRight: () => stand(state.view + 1) }[event.key];
    if (act) { event.preventDefault(); act(); }
  });
  canvas.addEventListener("webglcontextlost", () => fail("The graphics card gave up. Reload the page; a smaller share of Gaussians may help."));
}

async function start() {
  if (!gl) return fail("This page needs WebGL 2, which this browser does not offer.");
  if (typeof DecompressionStream === "undefined") return fail("This page needs a browser of 2023 or newer.");
  // A link may say what to show: #method=backbone&view=v2&tint=1&frusta=0&bare=1
  const wish = new URLSearchParams(location.hash.slice(1));
  for (const method of facts.methods) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: method.label });
    button.dataset.method = method.name;
    button.setAttribute("role", "tab");
    button.addEventListener("click", () => show(method));
    $("methods").append(button);
  }
  for (const name of ["tint", "frusta"]) if (wish.has(name)) $(name).checked = state[name] = wish.get(name) === "1";
  if (wish.get("bare") === "1") document.body.classList.add("bare");
  prepare();
  listen();
  await show(facts.methods.find((method) => method.name === wish.get("method")) || state.method);
  stand(Math.max(0, state.method.views.findIndex((view) => view.id === wish.get("view"))));
  draw();
  document.documentElement.dataset.state = "ready";
  return undefined;
}
start().catch((error) => fail(`The scene cannot be shown: ${error.message}`));
