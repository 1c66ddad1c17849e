"use strict";
// Point clouds in WebGL: one canvas per sensor, one view for all of them.

const VERTEX = `
attribute vec3 position; attribute vec3 color;
uniform mat4 matrix; uniform float size; varying vec3 tint;
void main() {
  gl_Position = matrix * vec4(position, 1.0);
  // Many points share a pixel of the canvas. Were the nearest drawn, errors that are too near would hide the others,
  // so points within 1 % of depth are drawn in random order.
  float random = fract(sin(dot(position, vec3(129.898, 782.33, 377.19))) * 43758.5453);
  vec4 moved = matrix * vec4(position * (0.995 + 0.01 * random), 1.0);
  gl_Position.z = moved.z / moved.w * gl_Position.w;
  gl_PointSize = clamp(size * -position.z / gl_Position.w, 1.0, 24.0);
  tint = color;
}`;
const FRAGMENT = `
precision mediump float; varying vec3 tint;
void main() { gl_FragColor = vec4(tint, 1.0); }`;

const START = { yaw: -0.45, pitch: 0.22, zoom: 1, shift: [0, 0] };

// Positions (3 per point; x right, y up, z towards the viewer, metres) and the pixel of each, of a depth image.
function unproject(instrument, z) {
  const [fx, fy, cx, cy] = instrument.camera, width = instrument.width;
  const count = z.reduce((n, v) => n + (v > 0), 0);
  const positions = new Float32Array(3 * count), pixels = new Uint32Array(count);
  let k = 0;
  for (let i = 0; i < z.length; i++) {
    if (!z[i]) continue;
    const depth = instrument.nearM + (z[i] - 1) * instrument.stepM;
    positions[3 * k] = ((i % width) + 0.5 - cx) / fx * depth;
    positions[3 * k + 1] = -(Math.floor(i / width) + 0.5 - cy) / fy * depth;
    positions[3 * k + 2] = -depth;
    pixels[k++] = i;
  }
  return { positions, pixels };
}

class CloudView {
  constructor(canvas, instrument, z, view) {
    this.canvas = canvas;
    this.view = view;
    this.camera = instrument.camera;
    this.height = instrument.height;
    Object.assign(this, unproject(instrument, z));
    const gl = this.gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL, so there are no point clouds to turn");
    this.program = this.link();
    this.fill("position", this.positions, gl.FLOAT, false);
    this.follow();
  }

  link() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0.063, 0.082, 0.114, 1);
    return program;
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
    const gl = this.gl, ratio = Math.min(window.devicePixelRatio || 1, 2), canvas = this.canvas;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const focal = 2 * this.camera[1] / this.height;  // the camera's own field of view
    gl.uniformMatrix4fv(gl.getUniformLocation(this.program, "matrix"), false, this.matrix(focal, width / height));
    gl.uniform1f(gl.getUniformLocation(this.program, "size"), 1.35 * focal * height / 2 / this.camera[1]);
    gl.drawArrays(gl.POINTS, 0, this.pixels.length);
  }

  // Turn about the centre at depth d, step back, project; column-major.
  matrix(focal, aspect) {
    const { yaw, pitch, zoom, shift, depth } = this.view;
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
