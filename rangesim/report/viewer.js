"use strict";
// Point clouds: one canvas per sensor and one view for all of them, in WebGL, or as still pictures without WebGL.

const VERTEX = `
attribute vec3 position; attribute vec3 color;
uniform mat4 matrix; uniform float size; uniform float centre; varying vec3 tint;
void main() {
  gl_Position = matrix * vec4(position, 1.0);
  // Many points share a pixel of the canvas. If the nearest were drawn, readings that are too near would hide the others.
  // Points within 1 % of depth are therefore drawn in random order.
  float random = fract(sin(dot(position, vec3(129.898, 782.33, 377.19))) * 43758.5453);
  vec4 moved = matrix * vec4(position * (0.995 + 0.01 * random), 1.0);
  gl_Position.z = moved.z / moved.w * gl_Position.w;
  float away = centre > 0.0 ? distance(position, vec3(0.0, 0.0, -centre)) : -position.z;
  gl_PointSize = clamp(size * away / gl_Position.w, 1.0, 24.0);
  tint = color;
}`;
const FRAGMENT = `
precision mediump float; varying vec3 tint;
void main() { gl_FragColor = vec4(tint, 1.0); }`;

const BACKGROUND = [16, 21, 29];
const START = { yaw: -0.45, pitch: 0.22, zoom: 1, shift: [0, 0] };

// Positions (3 per point; x right, y up, z towards the viewer, metres) and the pixel of each, of a depth image.
// The camera is the pinhole of rangesim.rig.camera_model, repeated here for the browser; tests/test_rig.py compares them.
// Distortion is left out. Other cameras have a ray for each pixel; if their points lie all around them, the camera is put
// where the view turns, at the middle depth.
function unproject(instrument, z) {
  const [fx, fy, cx, cy] = instrument.camera, width = instrument.width, rays = instrument.rays;
  const count = z.reduce((n, v) => n + (v > 0), 0);
  const positions = new Float32Array(3 * count), pixels = new Uint32Array(count);
  let k = 0;
  for (let i = 0; i < z.length; i++) {
    if (!z[i]) continue;
    const depth = instrument.nearM + (z[i] - 1) * instrument.stepM;
    if (rays) {
      const at = (axis) => rays.directions[3 * i + axis] / 32767 * depth + (rays.origins ? rays.origins[3 * i + axis] : 0);
      positions.set([at(0), -at(1), -at(2) - (rays.surrounds ? instrument.middleM : 0)], 3 * k);
      pixels[k++] = i;
      continue;
    }
    positions[3 * k] = ((i % width) + 0.5 - cx) / fx * depth;
    positions[3 * k + 1] = -(Math.floor(i / width) + 0.5 - cy) / fy * depth;
    positions[3 * k + 2] = -depth;
    pixels[k++] = i;
  }
  return { positions, pixels };
}

// Focal length over half the canvas's height, with which a canvas of an aspect shows the camera's whole field of view.
function focalOf(instrument, aspect) {
  const [fx, fy] = instrument.camera;
  if (instrument.rays) return Math.min(1.6, 1.6 * aspect);
  return Math.min(2 * fy / instrument.height, aspect * 2 * fx / instrument.width);
}

// Size of a point in pixels of a canvas, with which the points of a surface seen from the camera cover it.
function pointSize(camera, focal, height) { return 1.35 * focal * height / 2 / camera[1]; }

// Matrix, column by column, that turns the points about the centre at a depth, moves them back and projects them.
function projection(view, depth, focal, aspect) {
  const { yaw, pitch, zoom, shift } = view;
  const [sy, cy, sp, cp] = [Math.sin(yaw), Math.cos(yaw), Math.sin(pitch), Math.cos(pitch)];
  const r = [[cy, 0, sy], [sp * sy, cp, -sp * cy], [-cp * sy, sp, cp * cy]];
  const back = depth * 1.12 / zoom, near = 0.02 * back, far = back + 20 * depth;
  const t = [shift[0] * back + r[0][2] * depth, shift[1] * back + r[1][2] * depth, r[2][2] * depth - back];
  const a = (far + near) / (near - far), b = 2 * far * near / (near - far);
  const columns = [];
  for (let j = 0; j < 4; j++) {
    const [x, y, z] = j < 3 ? [r[0][j], r[1][j], r[2][j]] : t;
    columns.push(focal / aspect * x, focal * y, a * z + (j === 3 ? b : 0), -z);
  }
  return new Float32Array(columns);
}

// Sets the canvas to the size at which it is shown; returns this size in pixels.
function fit(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  return [width, height];
}

// WebGL context of a canvas with the program that draws clouds; null if the browser or its driver has no WebGL.
function openWebGL(canvas) {
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) return null;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(...BACKGROUND.map((c) => c / 255), 1);
  return { gl, program };
}

// View of a cloud that turns, or a still picture of it.
function cloudView(canvas, instrument, z, view) {
  const opened = openWebGL(canvas);
  if (opened) return new CloudView(canvas, instrument, z, view, opened);
  const fresh = canvas.cloneNode();  // a canvas that was asked for WebGL may refuse a 2D context
  canvas.replaceWith(fresh);
  return new StillView(fresh, instrument, z, view);
}

// Still picture of a cloud from the first place of the view, drawn without WebGL.
class StillView {
  constructor(canvas, instrument, z, view) {
    Object.assign(this, { canvas, view, instrument }, unproject(instrument, z));
    canvas.classList.add("still");
  }

  // colors: RGB bytes per pixel of the image
  paint(colors) { this.colors = colors; }

  draw() {
    const [width, height] = fit(this.canvas);
    if (!(width && height)) return;
    const one = this.instrument, focal = focalOf(one, width / height), size = pointSize(one.camera, focal, height);
    const m = projection(this.view, one.middleM, focal, width / height), positions = this.positions;
    const surrounds = one.rays && one.rays.surrounds;
    const context = this.canvas.getContext("2d"), image = context.createImageData(width, height);
    const nearest = new Float32Array(width * height).fill(Infinity), shown = new Uint32Array(image.data.buffer);
    const color = (r, g, b) => new Uint32Array(new Uint8Array([r, g, b, 255]).buffer)[0];
    shown.fill(color(...BACKGROUND));
    for (let k = 0; k < this.pixels.length; k++) {
      const [x, y, z] = positions.subarray(3 * k, 3 * k + 3), w = m[3] * x + m[7] * y + m[11] * z + m[15];
      if (w <= 0) continue;
      const away = surrounds ? Math.hypot(x, y, z + one.middleM) : -z;
      const side = Math.max(1, Math.min(24, size * away / w)), depth = w * (0.995 + 0.01 * (k * 0.618033988749895 % 1));
      const left = (0.5 + 0.5 * (m[0] * x + m[4] * y + m[8] * z + m[12]) / w) * width - side / 2;
      const top = (0.5 - 0.5 * (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) * height - side / 2;
      const rgb = color(...this.colors.subarray(3 * this.pixels[k], 3 * this.pixels[k] + 3));
      for (let j = Math.max(0, Math.round(top)); j < Math.min(height, Math.round(top + side)); j++) {
        for (let i = Math.max(0, Math.round(left)); i < Math.min(width, Math.round(left + side)); i++) {
          if (depth >= nearest[j * width + i]) continue;
          nearest[j * width + i] = depth;
          shown[j * width + i] = rgb;
        }
      }
    }
    context.putImageData(image, 0, 0);
  }
}

class CloudView {
  constructor(canvas, instrument, z, view, opened) {
    Object.assign(this, { canvas, view, instrument }, opened, unproject(instrument, z));
    this.fill("position", this.positions, this.gl.FLOAT, false);
    this.follow();
  }

  fill(name, data, type, normalised) {
    const gl = this.gl, place = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, type, normalised, 0, 0);
  }

  // colors: RGB bytes per pixel of the image
  paint(colors) {
    const own = new Uint8Array(3 * this.pixels.length);
    for (let k = 0; k < this.pixels.length; k++) {
      for (let c = 0; c < 3; c++) own[3 * k + c] = colors[3 * this.pixels[k] + c];
    }
    const gl = this.gl, place = gl.getAttribLocation(this.program, "color");
    if (!this.colors) this.colors = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.colors);
    gl.bufferData(gl.ARRAY_BUFFER, own, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, gl.UNSIGNED_BYTE, true, 0, 0);
  }

  draw() {
    const gl = this.gl, [width, height] = fit(this.canvas);
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const one = this.instrument, focal = focalOf(one, width / height);
    const matrix = projection(this.view, one.middleM, focal, width / height);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.program, "matrix"), false, matrix);
    gl.uniform1f(gl.getUniformLocation(this.program, "centre"), one.rays && one.rays.surrounds ? one.middleM : 0);
    gl.uniform1f(gl.getUniformLocation(this.program, "size"), pointSize(one.camera, focal, height));
    gl.drawArrays(gl.POINTS, 0, this.pixels.length);
  }

  follow() {
    const { canvas, view } = this;
    let last = null;
    canvas.addEventListener("pointerdown", (e) => { last = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", () => { last = null; });
    canvas.addEventListener("pointermove", (e) => {
      if (!last) return;
      const dx = (e.clientX - last[0]) / canvas.clientHeight, dy = (e.clientY - last[1]) / canvas.clientHeight;
      last = [e.clientX, e.clientY];
      if (e.shiftKey || e.buttons & 2) {
        view.shift = [view.shift[0] + dx, view.shift[1] - dy];
      } else {
        view.yaw += 3 * dx;
        view.pitch = Math.max(-1.5, Math.min(1.5, view.pitch + 3 * dy));
      }
      view.changed();
    });
    canvas.addEventListener("dblclick", () => (document.fullscreenElement ? document.exitFullscreen() : canvas.requestFullscreen()));
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      view.zoom = Math.max(0.2, Math.min(20, view.zoom * Math.exp(-0.0015 * e.deltaY)));
      view.changed();
    }, { passive: false });
  }
}
