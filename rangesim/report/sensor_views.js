"use strict";
// Point clouds of sensors: one canvas per sensor and one view for all of them, drawn by points.js of pcgraph's viewer.

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
function pointSize(camera, focal, height) { return 1.45 * focal * height / 2 / camera[1]; }

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

// View of a cloud that turns, or a still picture of it from the first place of the view.
class CloudView {
  constructor(canvas, instrument, z, view) {
    this.scene = openScene(canvas);
    this.isStill = this.scene instanceof StillScene;
    Object.assign(this, { canvas: this.scene.canvas, view, instrument }, unproject(instrument, z));
    this.scene.shading = false;
    const surrounds = instrument.rays && instrument.rays.surrounds;
    this.scene.show({
      steps: this.positions, step: [1, 1, 1], corner: [0, 0, 0], leaf: new Uint32Array(this.pixels.length),
      seenFrom: [0, 0, surrounds ? -instrument.middleM : 0] });
    this.painting = painting(0);
    this.camera = new THREE.Camera();
    if (!this.isStill) this.follow();
  }

  // colors: RGB bytes per pixel of the image
  paint(colors) {
    const own = new Uint8Array(3 * this.pixels.length);
    for (let k = 0; k < this.pixels.length; k++) {
      for (let c = 0; c < 3; c++) own[3 * k + c] = colors[3 * this.pixels[k] + c];
    }
    this.painting.key = colorKeys(own);
    this.scene.paint(this.painting);
  }

  draw() {
    const [width, height] = fit(this.canvas), one = this.instrument;
    if (!(width && height)) return;
    const focal = focalOf(one, width / height);
    this.camera.projectionMatrix.fromArray(projection(this.view, one.middleM, focal, width / height));
    this.scene.draw(this.camera, pointSize(one.camera, focal, height), 1);
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
