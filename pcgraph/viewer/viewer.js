"use strict";
// The page: what is shown, how it is coloured, what was picked.

const $ = (id) => document.getElementById(id);
const FIELD_OF_VIEW = 45;  // degrees, from top to bottom
const START_FROM = [-0.55, -0.8, 0.5];  // where the viewer is, seen from the middle, for a cloud whose z is up
const PICK_REACH = 5;  // pixels
const CLICK_REACH = 4;  // pixels that the pointer may move during a click
const SIZE_IN_SPACINGS = 2.6;  // so that three quarters of a surface of random points are covered; by eye, not varied
const SLOW_MS = 50;  // time between two frames of a moving view above which fewer points are drawn until it rests
const REST_MS = 200;  // time without a movement after which the view rests
const LEAST_PART = 1 / 16;  // of the points, that is drawn however slow the graphics are
const LARGEST_LEGEND = 12;
const EDGE_COLORS = [[0.33, 0.64, 0.96], [0.95, 0.55, 0.22], [0.73, 0.76, 0.8]];  // convex, concave, gap; as in viewer.css
const CHOSEN_COLOR = [1, 0.83, 0.25];
const FIXED_COLORINGS = { level: "Segments of the level", object: "Objects", part: "Parts", supervoxel: "Supervoxels", own: "Own colours", normal: "Normals", height: "Height" };

// Names come from files: they become text, never markup.
function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

function css([r, g, b]) { return `rgb(${Math.round(r)} ${Math.round(g)} ${Math.round(b)})`; }

function swatch(color) {
  const box = make("i");
  box.style.background = color;
  return box;
}

function number(value, digits = 4) {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "none" : value > 0 ? "infinite" : "−infinite";
  if (Number.isInteger(value) && Math.abs(value) < 1e15) return value.toLocaleString("en").replace("-", "−");
  const size = Math.abs(value);
  const text = size >= 1e7 || size < 1e-4 ? value.toPrecision(digits) : size >= 1e3 ? value.toFixed(1) : String(+value.toPrecision(digits));
  return text.replace("-", "−");
}

// A value of a column, to the digits that its steps have.
function valueText(column, value) {
  if (column.whole) return number(Math.round(value));
  return Math.abs(value) < 1e-4 || column.step > 1e6 ? number(value) : value.toFixed(Math.min(6, digitsOf(column.step))).replace("-", "−");
}

function counted(count, one, many = `${one}s`) { return `${count.toLocaleString("en")} ${count === 1 ? one : many}`; }

// Digits after the point that a coordinate in steps of this size has; 1 is the step of a constant, which is exact.
function digitsOf(step) { return step === 1 ? 6 : Math.max(0, Math.min(9, Math.ceil(-Math.log10(step)))); }

function metres(length) { return length >= 1 ? `${number(length, 3)} m` : length >= 1e-3 ? `${number(1e3 * length, 3)} mm` : `${number(1e6 * length, 2)} µm`; }

async function unpackCloud(data) {
  const cloud = { ...data }, { count } = data;
  const planes = await unpack(data.positions, Uint16Array);
  cloud.steps = new Uint16Array(3 * count);
  for (let axis = 0; axis < 3; axis++) for (let i = 0; i < count; i++) cloud.steps[3 * i + axis] = planes[axis * count + i];
  cloud.corner = data.low.map((low, axis) => low - data.middle[axis]);  // step 0, in the view's frame, whose origin is the middle
  cloud.reach = Math.hypot(...cloud.corner.map((low, axis) => Math.max(Math.abs(low), Math.abs(low + 65535 * data.step[axis]))));
  for (const name of ["colors", "normals"]) cloud[name] = data[name] && await unpack(data[name], Uint8Array);
  cloud.index = data.index && await unpack(data.index, Uint32Array);
  cloud.columns = await Promise.all(data.columns.map(async (column) => ({
    ...column, keys: Uint32Array.from(await unpack(column.keys, column.wide ? Uint32Array : Uint16Array)),
    colors: column.colors && await unpack(column.colors, Uint8Array) })));
  cloud.tree = data.tree && await Tree.unpack(data.tree);
  cloud.leaf = cloud.tree ? Uint32Array.from(cloud.tree.leaf) : new Uint32Array(count);
  return cloud;
}

function numberTable(colors) {
  const table = tableBytes(257);
  table.set([...NO_VALUE, 255], 0);
  for (let i = 0; i < 256; i++) table.set(colors.slice(3 * i, 3 * i + 3), 4 * (i + 1));
  return table;
}

function categoryTable(colors) {
  const count = colors.length / 3, table = tableBytes(count + 1);
  table.set([...NO_VALUE, 255], 0);
  for (let i = 0; i < count; i++) table.set(colors.subarray(3 * i, 3 * i + 3), 4 * (i + 1));
  return table;
}

class Viewer {
  constructor() {
    this.scene = openScene($("view"));
    this.canvas = this.scene.canvas;
    this.isStill = this.scene instanceof StillScene;
    this.eye = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.1, 10);
    this.parallelEye = new THREE.OrthographicCamera();
    this.target = new THREE.Vector3();
    $("still-note").hidden = !this.isStill;
    $("of-view").hidden = $("reset").hidden = $("help").hidden = this.isStill;
    this.listen();
  }

  async load(at) {
    const block = $(`cloud-${at}`);
    const cloud = this.cloud = await unpackCloud(JSON.parse(block.textContent)), { tree } = cloud;
    Object.assign(this, { chosen: null, part: 1, moving: false, drawn: -Infinity });
    this.paint = painting(tree ? tree.leaves : 0);
    this.scene.show(cloud);
    for (const name of ["boxLines", "edgeLines", "chosenLines"]) { this.scene.removeLines(this[name]); this[name] = null; }
    for (const part of document.querySelectorAll(".of-tree")) part.hidden = !tree;
    $("show-edges").parentElement.hidden = !tree?.edgeKinds.length;
    $("branches").hidden = !(tree && $("show-branches").checked);
    $("edge-legend").hidden = !(tree && $("show-edges").checked);
    $("picked").hidden = $("ring").hidden = true;
    $("up").value = cloud.camera ? "0 -1 0" : "0 0 1";
    this.summarise();
    this.fillColorings();
    if (tree) {
      $("count").max = tree.leaves;
      $("to-objects").textContent = counted(tree.objectCount, "object");
      $("to-parts").textContent = counted(tree.partCount, "part");
      $("marks").replaceChildren(...[tree.objectCount, tree.partCount].map((n) => {
        const mark = make("i");
        mark.style.left = `${this.place(n) / 10}%`;
        return mark;
      }));
      this.dendrogram = new Dendrogram($("dendrogram"), tree, (node) => this.choose(node));
      $("branches-note").textContent = counted(Math.min(MAX_BRANCHES, tree.leaves - 1), "coarsest merge");
      this.setCount(tree.objectCount, false);
    }
    this.setUp();
    this.color($("color").value);
    this.toggleLines();
  }

  summarise() {
    const { count, unmeasured, far, step, tree, columnsLeftOut } = this.cloud;
    const said = [`${counted(count, "point")}, placed to ${metres(Math.hypot(...step.filter((s) => s !== 1)) / 2)}.`];
    if (unmeasured) said.push(`${counted(unmeasured, "point")} without a measurement.`);
    if (far) said.push(`${counted(far, "point")} far outside not shown.`);
    if (columnsLeftOut) said.push(`${counted(columnsLeftOut, "further column")} not in this page.`);
    if (tree) said.push(`${counted(tree.leaves, "supervoxel")}, tree by ${tree.linkage}.`);
    $("summary").textContent = said.join(" ");
  }

  // ---- Colours -----------------------------------------------------------------------------------------------------

  fillColorings() {
    const { cloud } = this, { tree } = cloud, select = $("color");
    const option = (value, text) => make("option", { value, textContent: text });
    const fixed = (names) => names.map((name) => option(name, FIXED_COLORINGS[name]));
    const groups = [];
    if (tree) groups.push(make("optgroup", { label: "Segmentation" }, ...fixed(["level", "object", "part", "supervoxel"])));
    groups.push(make("optgroup", { label: "Cloud" }, ...fixed([...(cloud.colors ? ["own"] : []), ...(cloud.normals ? ["normal"] : []), "height"])));
    if (cloud.columns.length) groups.push(make("optgroup", { label: "Columns" }, ...cloud.columns.map((c, i) => option(`column ${i}`, c.name))));
    select.replaceChildren(...groups);
    const intensity = cloud.columns.findIndex((c) => /intensity|reflect/i.test(c.name));
    select.value = tree ? "level" : cloud.colors ? "own" : intensity >= 0 ? `column ${intensity}` : "height";
  }

  color(name) {
    const { cloud, paint } = this, { tree } = cloud;
    $("color").value = name;
    this.coloring = name;
    paint.key = null;
    $("legend").replaceChildren();
    if (["level", "object", "part", "supervoxel"].includes(name)) {
      paint.way = BY_SEGMENT;
      this.paintSegments();
      return;
    }
    if (name === "own" || name === "normal") {
      paint.way = BY_COLOR;
      paint.key = colorKeys(name === "own" ? cloud.colors : cloud.normals);
    } else if (name === "height") this.byHeight();
    else this.byColumn(cloud.columns[+name.split(" ")[1]]);
    this.repaint();
  }

  byHeight() {
    const { cloud, paint } = this, up = this.up(), axis = up.findIndex((u) => u !== 0), rises = up[axis] > 0;
    const keys = paint.key = new Uint32Array(cloud.count), high = 65535;
    for (let i = 0; i < cloud.count; i++) keys[i] = 1 + (rises ? cloud.steps[3 * i + axis] : high - cloud.steps[3 * i + axis]);
    const sorted = keys.slice().sort(), part = (p) => sorted[Math.floor(p * (cloud.count - 1))] ?? 1;
    const ends = [part(0.01), Math.max(part(0.99), part(0.01) + 1)];
    paint.way = BY_NUMBER;
    paint.table = numberTable(cloud.colorTable);
    paint.shown = ends;
    const metresAt = (key) => rises ? cloud.low[axis] + cloud.step[axis] * (key - 1) : -(cloud.low[axis] + cloud.step[axis] * (high - key + 1));
    this.bar(metresAt(ends[0]), metresAt(ends[1]), " m");
  }

  byColumn(column) {
    const { paint } = this;
    paint.key = column.keys;
    if (column.values) {
      paint.way = BY_CATEGORY;
      paint.table = categoryTable(column.colors);
      this.categories(column);
      return;
    }
    paint.way = BY_NUMBER;
    paint.table = numberTable(this.cloud.colorTable);
    paint.shown = column.shown.map((v) => 1 + (v - column.low) / column.step);
    if (paint.shown[0] === paint.shown[1]) paint.shown[1]++;
    this.bar(column.shown[0], column.shown[1], column.unit && ` ${column.unit}`);
    if (column.keys.includes(0)) $("legend").append(make("ul", { className: "legend" }, make("li", {}, swatch(css(NO_VALUE)), "no value")));
  }

  bar(low, high, unit) {
    const canvas = make("canvas", { width: 256, height: 1, className: "bar" }), context = canvas.getContext("2d"), image = context.createImageData(256, 1);
    for (let i = 0; i < 256; i++) image.data.set([...this.cloud.colorTable.slice(3 * i, 3 * i + 3), 255], 4 * i);
    context.putImageData(image, 0, 0);
    const ends = [low, (low + high) / 2, high].map((v) => make("span", { textContent: number(v) + unit }));
    $("legend").append(canvas, make("div", { className: "ends" }, ...ends));
  }

  categories(column) {
    const counts = new Uint32Array(column.values.length + 1);
    for (const key of column.keys) counts[key]++;
    const order = column.values.map((_, i) => i).sort((a, b) => counts[b + 1] - counts[a + 1]), shown = order.slice(0, LARGEST_LEGEND);
    const items = shown.map((i) => make("li", {}, swatch(css(column.colors.subarray(3 * i, 3 * i + 3))), column.values[i]));
    if (order.length > shown.length) items.push(make("li", { textContent: `and ${counted(order.length - shown.length, "other")}` }));
    $("legend").append(make("ul", { className: "legend" }, ...items));
  }

  // Sets the colour of each supervoxel, and dims those outside the chosen node; the points stay as they are.
  paintSegments() {
    const { tree } = this.cloud, { segments } = this.paint;
    if (tree && this.paint.way === BY_SEGMENT) {
      const source = this.coloring === "supervoxel" ? tree.leafColors : tree.colors, node = this.nodesShown();
      for (let leaf = 0; leaf < tree.leaves; leaf++) {
        const from = 3 * node[leaf], to = 4 * (leaf + 1);
        segments[to] = source[from];
        segments[to + 1] = source[from + 1];
        segments[to + 2] = source[from + 2];
      }
    }
    if (tree) {
      const inside = this.chosen?.inside, dim = Math.round(255 * DIM);
      segments[3] = inside ? dim : 255;
      for (let leaf = 0; leaf < tree.leaves; leaf++) segments[4 * (leaf + 1) + 3] = !inside || inside[leaf] ? 255 : dim;
    }
    this.repaint();
  }

  // Node whose colour each leaf has.
  nodesShown() {
    const { tree } = this.cloud;
    if (this.coloring === "level") return tree.cut(this.count);
    if (this.coloring === "object") return this.chiefs(tree.objects, tree.cut(tree.objectCount));
    if (this.coloring === "part") return this.chiefs(tree.parts, tree.cut(tree.partCount));
    return Int32Array.from({ length: tree.leaves }, (_, leaf) => leaf);
  }

  // Node of a cut that gives each group of leaves its colour: that of the group's largest leaf.
  chiefs(groups, cut) {
    const { tree } = this.cloud, largest = new Map();
    groups.forEach((group, leaf) => {
      if (!largest.has(group) || tree.sizes[leaf] > tree.sizes[largest.get(group)]) largest.set(group, leaf);
    });
    return groups.map((group) => cut[largest.get(group)]);
  }

  repaint() {
    this.scene.paint(this.paint);
    this.redraw();
  }

  // ---- Levels ------------------------------------------------------------------------------------------------------

  // Place on the slider, 0..1000, of a number of segments; and back.
  place(count) { return this.cloud.tree.leaves > 1 ? 1000 * Math.log(count) / Math.log(this.cloud.tree.leaves) : 0; }

  countAt(place) { return Math.round(Math.exp(place / 1000 * Math.log(this.cloud.tree.leaves))); }

  setCount(count, recolor = true) {
    const { tree } = this.cloud;
    this.count = Math.max(1, Math.min(tree.leaves, Math.round(count) || 1));
    const altitude = tree.altitude(this.count);
    const said = this.count === tree.leaves ? "nothing merged" : altitude === Infinity ? "parts that do not touch joined" : `altitude ${number(altitude, 3)}`;
    $("count").value = this.count;
    $("level").value = this.place(this.count);
    $("level").setAttribute("aria-valuetext", `${counted(this.count, "segment")}, ${said}`);
    $("altitude").textContent = said[0].toUpperCase() + said.slice(1);
    if (!$("branches").hidden) this.dendrogram.show(this.count, this.chosen?.node);
    if (!recolor) return;
    if (this.coloring === "level") this.paintSegments(); else this.color("level");
  }

  // ---- The view ----------------------------------------------------------------------------------------------------

  up() { return $("up").value.split(" ").map(Number); }

  setUp() {
    this.eye.up.fromArray(this.up());
    this.resetView();
    if (this.coloring === "height") this.color("height");
  }

  resetView() {
    const { cloud } = this, up = this.up(), away = (cloud.camera ? 0.85 : 0.92) * cloud.radius / Math.tan(FIELD_OF_VIEW / 2 * Math.PI / 180) / Math.min(1, this.aspect());
    let from = START_FROM;
    if (cloud.camera && up[1] === -1) from = [-0.22, -0.16, -1];
    else if (up[2] !== 1) from = [...[0, 1, 2].map((a) => (up[a] ? 0.5 * up[a] : a === 2 ? 0.8 : 0.55))];
    this.target.set(0, 0, 0);
    this.eye.position.fromArray(from).setLength(away);
    if (!this.isStill) this.orbit();
    this.redraw();
  }

  orbit() {
    this.controls?.dispose();
    const controls = this.controls = new THREE.OrbitControls(this.eye, this.canvas);
    controls.target = this.target;
    controls.zoomToCursor = true;
    controls.minDistance = 1e-3 * this.cloud.radius;
    controls.maxDistance = 30 * this.cloud.radius;
    controls.addEventListener("change", () => this.move());
    controls.update();
  }

  aspect() { return this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight); }

  // Camera of this moment, with planes that hold the cloud.
  camera() {
    const { eye, parallelEye, cloud } = this, aspect = this.aspect(), centre = new THREE.Vector3();
    eye.aspect = aspect;
    eye.lookAt(this.target);
    if ($("projection").value === "perspective") {
      setPlanes(eye, centre, cloud.reach + 1e-6);
      return eye;
    }
    const away = eye.position.distanceTo(this.target), half = away * Math.tan(FIELD_OF_VIEW / 2 * Math.PI / 180);
    Object.assign(parallelEye, { left: -half * aspect, right: half * aspect, top: half, bottom: -half });
    parallelEye.quaternion.copy(eye.quaternion);
    parallelEye.position.copy(eye.position).sub(this.target).setLength(away + cloud.reach + this.target.length()).add(this.target);
    setPlanes(parallelEye, centre, cloud.reach + 1e-6);
    return parallelEye;
  }

  // Draws a view that moves; on slow graphics with a part of the points, until it rests.
  move() {
    this.moving = true;
    clearTimeout(this.resting);
    this.resting = setTimeout(() => { this.moving = false; this.redraw(); }, REST_MS);
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => { this.waiting = 0; this.draw(); });
  }

  draw() {
    if (!this.cloud || !this.paint) return;
    const camera = this.camera(), { canvas } = this, bigger = 2 ** +$("size").value, size = SIZE_IN_SPACINGS * bigger * this.cloud.spacing;
    const now = performance.now(), since = now - this.drawn;
    if (this.moving && since > SLOW_MS && since < 10 * REST_MS) this.part = Math.max(LEAST_PART, this.part / 2);
    this.drawn = this.moving ? now : -Infinity;
    this.scene.draw(camera, size * pixelsPerMetre(camera, fit(canvas)[1]), Math.max(1, 1.5 * bigger), size, this.moving ? this.part : 1);
    const ring = $("ring");
    ring.hidden = this.pickedPoint === undefined || this.pickedPoint < 0;
    if (ring.hidden) return;
    const at = new THREE.Vector3(...this.local(this.pickedPoint)).project(camera);
    ring.hidden = Math.abs(at.z) > 1;
    ring.style.left = `${50 + 50 * at.x}%`;
    ring.style.top = `${50 - 50 * at.y}%`;
  }

  turn(right, up) {
    const offset = this.eye.position.clone().sub(this.target), pole = this.eye.up, tilt = pole.angleTo(offset);
    const across = new THREE.Vector3().crossVectors(pole, offset).normalize();
    offset.applyAxisAngle(across, Math.max(0.05, Math.min(Math.PI - 0.05, tilt - up)) - tilt).applyAxisAngle(pole, right);
    this.eye.position.copy(this.target).add(offset);
    this.moved();
  }

  shift(right, up) {
    const away = this.eye.position.distanceTo(this.target), step = new THREE.Vector3(right * away, up * away, 0).applyQuaternion(this.eye.quaternion);
    this.eye.position.add(step);
    this.target.add(step);
    this.moved();
  }

  zoom(factor) {
    this.eye.position.sub(this.target).multiplyScalar(factor).add(this.target);
    this.moved();
  }

  moved() {
    this.controls.update();
    this.move();
  }

  press(event) {
    const turns = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Enter") this.pick(this.canvas.clientWidth / 2, this.canvas.clientHeight / 2, 40);
    else if (event.key === "Escape") this.forget();
    else if (this.isStill) return;
    else if (turns && event.shiftKey) this.shift(-0.06 * turns[0], 0.06 * turns[1]);
    else if (turns) this.turn(0.12 * turns[0], 0.12 * turns[1]);
    else if (event.key === "+" || event.key === "=") this.zoom(0.85);
    else if (event.key === "-") this.zoom(1 / 0.85);
    else return;
    event.preventDefault();
  }

  // ---- Lines -------------------------------------------------------------------------------------------------------

  toggleLines() {
    const { tree } = this.cloud;
    if (!tree) return;
    $("edge-legend").hidden = !$("show-edges").checked;
    $("branches").hidden = !$("show-branches").checked;
    if (!$("branches").hidden) this.dendrogram.show(this.count, this.chosen?.node);
    if (!this.edgeLines && $("show-edges").checked) this.edgeLines = this.edgeStrips();
    if (!this.boxLines && $("show-boxes").checked) this.boxLines = this.boxStrips();
    if (this.edgeLines) this.edgeLines.visible = $("show-edges").checked;
    if (this.boxLines) this.boxLines.visible = $("show-boxes").checked;
    this.redraw();
  }

  edgeStrips() {
    const { tree, middle } = this.cloud, shift = tree.origin.map((o, a) => o - middle[a]);
    const ends = new Float32Array(3 * tree.edges.length), colors = new Float32Array(3 * tree.edgeKinds.length);
    tree.edges.forEach((leaf, i) => { for (let a = 0; a < 3; a++) ends[3 * i + a] = tree.centroids[3 * leaf + a] + shift[a]; });
    tree.edgeKinds.forEach((kind, i) => colors.set(EDGE_COLORS[kind], 3 * i));
    return this.scene.addLines(ends, colors, { width: 1.1, opacity: 0.9, lift: 6 * this.cloud.spacing });
  }

  boxStrips() {
    const { tree } = this.cloud, cut = this.chiefs(tree.objects, tree.cut(tree.objectCount)), ends = [], colors = [];
    const leafOf = new Map();
    tree.objects.forEach((object, leaf) => { if (!leafOf.has(object)) leafOf.set(object, leaf); });
    for (const box of tree.boxes) {
      const node = cut[leafOf.get(box.object)], color = [...tree.colors.subarray(3 * node, 3 * node + 3)].map((c) => 0.35 + 0.65 * c / 255);
      ends.push(...boxEdges(this.inView(box)));
      for (let i = 0; i < 12; i++) colors.push(...color);
    }
    return this.scene.addLines(new Float32Array(ends), new Float32Array(colors), { width: 1.6, lift: 3 * this.cloud.spacing });
  }

  inView(box) { return { ...box, center: box.center.map((c, a) => c - this.cloud.middle[a]) }; }

  // ---- Picking -----------------------------------------------------------------------------------------------------

  local(point) { return [0, 1, 2].map((a) => this.cloud.corner[a] + this.cloud.step[a] * this.cloud.steps[3 * point + a]); }

  pick(left, top, reach = PICK_REACH) {
    const point = pointAt(this.cloud, this.camera(), this.canvas, left, top, reach);
    if (point < 0) return;
    this.pickedPoint = point;
    this.showPoint(point);
    const { tree, leaf } = this.cloud;
    $("of-node").hidden = !(tree && leaf[point]);
    $("picked").hidden = false;
    if (tree && leaf[point]) {
      this.path = tree.path(leaf[point] - 1);
      this.choose(this.path.find((node) => this.isShown(node)) ?? this.path[0]);
    } else this.choose(null);
  }

  // Whether a node is a segment of what is shown: of the level, or of the objects if something else is.
  isShown(node) {
    const { tree } = this.cloud, count = { supervoxel: tree.leaves, part: tree.partCount, level: this.count }[this.coloring] ?? tree.objectCount;
    const end = tree.end(count), parent = tree.parents[node];
    return node < end && (parent >= end || parent === node);
  }

  choose(node) {
    const { tree } = this.cloud;
    this.scene.removeLines(this.chosenLines);
    this.chosenLines = null;
    this.chosen = null;
    if (node !== null) {
      const inside = tree.below(node), box = this.boxOf(node, inside);
      if (!this.path?.includes(node)) {
        let leaf = node;
        while (leaf >= tree.leaves) {
          const [a, b] = tree.children.subarray(2 * leaf, 2 * leaf + 2);
          leaf = tree.sizes[a] >= tree.sizes[b] ? a : b;
        }
        this.path = tree.path(leaf);
      }
      this.chosen = { node, inside, box };
      if (box) this.chosenLines = this.scene.addLines(new Float32Array(boxEdges(box)), new Float32Array(12 * 3).map((_, i) => CHOSEN_COLOR[i % 3]), { width: 2, lift: 3.5 * this.cloud.spacing });
      $("picked").hidden = $("of-node").hidden = false;
      this.showNode();
    }
    if (!$("branches").hidden) this.dendrogram.show(this.count, node);
    this.paintSegments();
  }

  // Tight box of an object; principal box of any other node.
  boxOf(node, inside) {
    const { tree } = this.cloud, object = tree.objects[inside.indexOf(1)];
    const isObject = tree.objects.every((o, leaf) => (o === object) === (inside[leaf] === 1));
    const tight = isObject && tree.boxes.find((box) => box.object === object);
    return tight ? { ...this.inView(tight), kind: "tight box" } : { ...principalBox(this.cloud, inside), kind: "principal box" };
  }

  forget() {
    this.pickedPoint = -1;
    this.path = null;
    $("picked").hidden = true;
    this.choose(null);
  }

  showPoint(point) {
    const { cloud } = this, { tree } = cloud, flat = cloud.index ? cloud.index[point] : point;
    const rows = [["point", cloud.width ? `row ${Math.floor(flat / cloud.width)}, column ${flat % cloud.width}` : number(flat)]];
    [..."xyz"].forEach((axis, a) => {
      const value = cloud.low[a] + cloud.step[a] * cloud.steps[3 * point + a];
      rows.push([axis, `${value.toFixed(digitsOf(cloud.step[a])).replace("-", "−")} m`]);
    });
    if (cloud.colors) {
      const color = cloud.colors.subarray(3 * point, 3 * point + 3);
      rows.push(["colour", [...color].join(", "), css(color)]);
    }
    if (cloud.normals) rows.push(["normal", [...cloud.normals.subarray(3 * point, 3 * point + 3)].map((b) => number((b - 127.5) / 127.5, 2)).join(", ")]);
    for (const column of cloud.columns) {
      const key = column.keys[point], value = column.low + column.step * (key - 1);
      rows.push([column.name, key === 0 ? "none" : column.values ? column.values[key - 1] : valueText(column, value) + (column.unit && ` ${column.unit}`)]);
    }
    if (tree && cloud.leaf[point]) {
      const leaf = cloud.leaf[point] - 1;
      rows.push(["object", number(tree.objects[leaf])], ["part", number(tree.parts[leaf])], ["supervoxel", number(leaf)]);
    } else if (tree) rows.push(["supervoxel", "none"]);
    this.fill("point", rows);
    $("forget").previousElementSibling.textContent = "Picked point";
  }

  fill(table, rows) {
    $(table).tBodies[0].replaceChildren(...rows.map(([name, value, color]) => make("tr", {}, make("td", { textContent: name }), make("td", {}, ...(color ? [swatch(color)] : []), value))));
  }

  showNode() {
    const { tree } = this.cloud, { node, box } = this.chosen, parent = tree.parents[node];
    $("node-title").textContent = node < tree.leaves ? `Supervoxel ${node}` : `Node ${node}`;
    const rows = [["points", number(tree.sizes[node])], ["altitude", number(tree.altitudes[node], 3)]];
    if (parent !== node) rows.push(["merges at altitude", number(tree.altitudes[parent], 3)]);
    if (box?.size) rows.push([box.kind, box.size.map((s) => number(s, 3)).join(" × ") + " m"]);
    for (const [name, value, unit] of tree.feature(node)) rows.push([name.replaceAll("_", " "), `${number(value)}${unit && ` ${unit}`}`]);
    this.fill("node", rows);
    const kin = [...tree.children.subarray(2 * node, 2 * node + 2)].filter((child) => child >= 0);
    const button = (text, to) => make("button", { type: "button", textContent: text, onclick: () => this.choose(to) });
    $("kin").replaceChildren(...(parent !== node ? [button(`Parent ${parent}`, parent)] : []), ...kin.map((child) => button(`Child ${child}`, child)));
    const end = tree.end(this.count);
    const entries = this.path.map((at) => {
      const isLevel = at < end && (tree.parents[at] >= end || tree.parents[at] === at);
      const name = at < tree.leaves ? `Supervoxel ${at}` : at === tree.nodes - 1 ? `Root ${at}` : `Node ${at}`;
      const row = make("button", { type: "button", onclick: () => { this.choose(at); } }, swatch(tree.color(at)), isLevel ? make("b", { textContent: `${name}, this level` }) : name);
      row.append(make("span", { textContent: `${counted(tree.sizes[at], "point")} · ${number(tree.altitudes[at], 3)}` }));
      row.setAttribute("aria-current", at === node);
      return make("li", {}, row);
    });
    const hadFocus = $("path").contains(document.activeElement);
    $("path").replaceChildren(...entries);
    const current = $("path").querySelector("[aria-current=true]");
    $("path").scrollTop = Math.max(0, (current?.offsetTop ?? 0) - $("path").offsetTop - 80);
    if (hadFocus) current?.focus({ preventScroll: true });
  }

  savePicture() {
    this.draw();  // in this very task, so that the picture is still there
    this.canvas.toBlob((blob) => {
      const link = make("a", { href: URL.createObjectURL(blob), download: `${this.cloud.name}.png` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }

  listen() {
    const on = (id, event, act) => $(id).addEventListener(event, act);
    on("file", "change", () => this.load(+$("file").value));
    on("color", "change", () => this.color($("color").value));
    on("level", "input", () => this.setCount(this.countAt(+$("level").value)));
    on("count", "change", () => this.setCount(+$("count").value));
    on("to-objects", "click", () => this.setCount(this.cloud.tree.objectCount));
    on("to-parts", "click", () => this.setCount(this.cloud.tree.partCount));
    for (const id of ["show-boxes", "show-edges", "show-branches"]) on(id, "change", () => this.toggleLines());
    on("size", "input", () => this.redraw());
    on("projection", "change", () => this.redraw());
    on("up", "change", () => this.setUp());
    on("shading", "change", () => { this.scene.shading = $("shading").checked; this.redraw(); });
    on("reset", "click", () => this.resetView());
    on("save", "click", () => this.savePicture());
    on("forget", "click", () => this.forget());
    let start = null;  // where a press began that has not moved since
    this.canvas.addEventListener("pointerdown", (e) => { start = e.button === 0 ? [e.clientX, e.clientY] : null; });
    this.canvas.addEventListener("pointermove", (e) => {
      if (start && Math.hypot(e.clientX - start[0], e.clientY - start[1]) > CLICK_REACH) start = null;
    });
    this.canvas.addEventListener("pointerup", (e) => {
      if (!start) return;
      start = null;
      const box = this.canvas.getBoundingClientRect();
      this.pick(e.clientX - box.left, e.clientY - box.top);
    });
    this.canvas.addEventListener("keydown", (e) => this.press(e));
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
  }
}

async function start() {
  const wanted = new URLSearchParams(location.hash.slice(1)), viewer = window.viewer = new Viewer();
  $("file-row").hidden = $("file").options.length < 2;
  const at = Math.min(Math.max(0, Math.trunc(+wanted.get("cloud")) || 0), $("file").options.length - 1);
  $("file").value = at;
  await viewer.load(at);
  if (viewer.cloud.tree && wanted.has("segments")) viewer.setCount(+wanted.get("segments"));
  const asked = [...$("color").options].find((option) => option.value === wanted.get("color") || option.textContent === wanted.get("color"));
  if (asked) viewer.color(asked.value);
  viewer.draw();
  document.documentElement.dataset.ready = "yes";
}
start();
