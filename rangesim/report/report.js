"use strict";
// The page's script: it unpacks the data, colours point clouds and label images, and shows the values of the maps.

const DATA = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const all = (selector) => [...document.querySelectorAll(selector)];

async function unpackInstrument(one) {
  const s = one.segmentation;
  const [z, error, intensity, status, cause] = await Promise.all([
    unpack(one.z, Uint16Array), unpack(one.error, Int16Array), unpack(one.intensity, Uint8Array), unpack(one.status, Uint8Array),
    unpack(one.cause, Uint8Array),
  ]);
  Object.assign(one, { z, error, intensity, status, cause });
  if (one.rays) {
    [one.rays.directions, one.rays.pixel] = await Promise.all([unpack(one.rays.directions, Int16Array), unpack(one.rays.pixel, Int32Array)]);
    if (one.rays.origins) one.rays.origins = await unpack(one.rays.origins, Float32Array);
  }
  if (s) [s.supervoxel, s.parents, s.altitudes, s.colors] = await Promise.all([
    unpack(s.supervoxel, s.wide ? Uint32Array : Uint16Array), unpack(s.parents, Int32Array),
    unpack(s.altitudes, Float32Array), unpack(s.colors, Uint8Array)]);
}

// Number of merges of a tree up to and including an altitude.
function merges(tree, altitude) {
  let low = tree.leaves, high = tree.altitudes.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (tree.altitudes[middle] <= altitude) low = middle + 1; else high = middle;
  }
  return low - tree.leaves;
}

// Node of the tree that holds each node once all merges up to an altitude are done.
function cut(tree, altitude) {
  const last = tree.leaves + merges(tree, altitude), owner = new Int32Array(last);
  for (let node = last - 1; node >= 0; node--) {
    const parent = tree.parents[node];
    owner[node] = parent < last && parent !== node ? owner[parent] : node;
  }
  return owner;
}

// Number of segments with more than 0.2 % of the points.
function large(one) {
  const sizes = new Uint32Array(one.owner.length);
  let points = 0;
  for (const s of one.segmentation.supervoxel) if (s) { sizes[one.owner[s - 1]]++; points++; }
  return sizes.filter((n) => n > 0.002 * points).length;
}

// Index of an error into the colours of the error scale, as in palette.error_fraction.
function errorIndex(metres) {
  const position = Math.asinh(metres / DATA.errorKneeM / 2) / Math.asinh(DATA.errorLimitM / DATA.errorKneeM / 2);
  return Math.round(255 * (0.5 + 0.5 * Math.max(-1, Math.min(1, position))));
}

const NOTHING = [203, 206, 210];

function put(rgb, i, from, k, shade) {
  rgb[3 * i] = from[k] * shade;
  rgb[3 * i + 1] = from[k + 1] * shade;
  rgb[3 * i + 2] = from[k + 2] * shade;
}

// Each function paints pixel i of an instrument into an array of RGB bytes.
const PAINT = {
  intensity: (one, i, rgb) => { rgb[3 * i] = rgb[3 * i + 1] = rgb[3 * i + 2] = one.intensity[i]; },
  error: (one, i, rgb) => {
    if (one.error[i] === -32768) put(rgb, i, NOTHING, 0, 1);
    else put(rgb, i, DATA.errorColors, 3 * errorIndex(one.error[i] * DATA.errorStepM), 1);
  },
  cause: (one, i, rgb) => put(rgb, i, DATA.causeColors, 3 * one.cause[i], 1),
  material: (one, i, rgb) => {
    const { material, materialColors } = DATA.passes[one.lightPass];
    put(rgb, i, materialColors[material[i]] || NOTHING, 0, 0.35 + 0.65 * one.intensity[i] / 255);
  },
  segments: (one, i, rgb) => {
    const s = one.segmentation, node = s && s.supervoxel[i] ? one.owner[s.supervoxel[i] - 1] : -1;
    if (node < 0) put(rgb, i, NOTHING, 0, 1);
    else put(rgb, i, s.colors, 3 * node, 0.7 + 0.3 * one.intensity[i] / 255);
  },
};

function colors(one, mode) {
  const rgb = new Uint8Array(3 * one.z.length), paint = PAINT[mode];
  for (let i = 0; i < one.z.length; i++) paint(one, i, rgb);
  return rgb;
}

// Columns and rows of the picture of an instrument's pixels.
function shownSize(one) { return one.rays ? [one.rays.columns, one.rays.rows] : [one.width, one.height]; }

function drawLabels(canvas, one, rgb) {
  [canvas.width, canvas.height] = shownSize(one);
  const context = canvas.getContext("2d"), image = context.createImageData(canvas.width, canvas.height);
  for (let place = 0; place < canvas.width * canvas.height; place++) {
    const i = one.rays ? one.rays.pixel[place] : place;
    for (let c = 0; c < 3; c++) image.data[4 * place + c] = i < 0 ? 224 : rgb[3 * i + c];
    image.data[4 * place + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

// Altitudes of the slider: those of the merges of all trees, highest first, at logarithmic positions, so that coarse levels get room.
class Levels {
  constructor(trees) {
    this.altitudes = trees.flatMap((t) => [...t.altitudes.subarray(t.leaves)]).filter(Number.isFinite).sort((a, b) => b - a);
    // the highest altitude of the merges in any tree's default cut: at this altitude every tree shows its default cut
    const done = trees.map((t) => t.leaves - t.objects).map((n, k) => n > 0 ? trees[k].altitudes[trees[k].leaves + n - 1] : 0);
    this.usual = Math.max(0, ...done.filter(Number.isFinite));
  }

  altitude(level) {  // 0: everything joined, 1000: nothing joined
    if (level <= 0) return Infinity;
    if (level >= 1000) return -1;
    return this.altitudes[Math.round(Math.exp(level / 1000 * Math.log(this.altitudes.length))) - 1] ?? -1;
  }

  level(altitude) {
    const above = this.altitudes.findIndex((a) => a <= altitude);
    if (altitude < 0 || above < 0) return 1000;
    return Math.max(1, Math.round(1000 * Math.log(above + 1) / Math.log(Math.max(2, this.altitudes.length))));
  }
}

class Page {
  constructor() {
    this.mode = "intensity";
    this.levels = new Levels(DATA.instruments.map((one) => one.segmentation).filter(Boolean));
    this.view = { ...START, changed: () => this.redraw() };
    for (const one of DATA.instruments) one.middleM = this.middle(one.view);
    this.clouds = all("canvas.cloud").map((c) => new CloudView(c, this.of(c), this.of(c).z, this.view));
    if (this.clouds.some((cloud) => cloud.isStill)) this.sayStill();
    $("level").addEventListener("input", () => { this.setMode("segments"); this.setAltitude(this.levels.altitude(+$("level").value)); });
    all("input[name=mode]").forEach((input) => input.addEventListener("change", () => { this.setMode(input.value); this.paint(); }));
    $("reset").addEventListener("click", () => { Object.assign(this.view, START); this.redraw(); });
    window.addEventListener("resize", () => this.redraw());
    all(".map").forEach((map) => {
      map.addEventListener("pointermove", (e) => this.probe(map, e));
      map.addEventListener("pointerleave", () => all(".map i").forEach((dot) => { dot.style.display = "none"; }));
    });
  }

  sayStill() {
    $("turning").textContent = "This browser has no WebGL, so the clouds are still pictures: their colours change, but they do not turn.";
    $("reset").hidden = true;
  }

  of(element) { return DATA.instruments[+element.dataset.instrument]; }

  middle(view) {  // metres, median depth of the first sensor of a camera that sees anything
    const one = DATA.instruments.find((o) => o.view === view && o.z.some((v) => v > 0));
    if (!one) return 1;
    const seen = one.z.filter((v) => v > 0).sort();
    return one.nearM + seen[seen.length >> 1] * one.stepM;
  }

  setMode(mode) {
    this.mode = mode;
    document.querySelector(`input[name=mode][value=${mode}]`).checked = true;
  }

  setAltitude(altitude, level) {
    if (level !== undefined) $("level").value = level;
    $("altitude").textContent = altitude < 0 ? "supervoxels" : altitude === Infinity ? "whole scene" : `${altitude.toPrecision(2)} rad`;
    for (const one of DATA.instruments) if (one.segmentation) one.owner = cut(one.segmentation, altitude);
    all("canvas.labels").forEach((canvas) => {
      const one = this.of(canvas), s = one.segmentation;
      one.segments = colors(one, "segments");
      drawLabels(canvas, one, one.segments);
      canvas.nextElementSibling.textContent = s
        ? `${s.leaves - merges(s, altitude)} segments, ${large(one)} of them larger than 0.2 % of the points; ${s.leaves} supervoxels`
        : "no points to segment";
    });
    if (this.mode === "segments") this.paint();
  }

  paint() {
    this.clouds.forEach((cloud) => {
      const one = this.of(cloud.canvas);
      cloud.paint(this.mode === "segments" ? one.segments : colors(one, this.mode));
    });
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => { this.waiting = 0; this.clouds.forEach((cloud) => cloud.draw()); });
  }

  probe(map, event) {
    const box = map.getBoundingClientRect(), here = this.of(map), [columns, rows] = shownSize(here);
    const x = Math.floor((event.clientX - box.left) / box.width * columns);
    const y = Math.floor((event.clientY - box.top) / box.height * rows), place = y * columns + x;
    const i = here.rays ? here.rays.pixel[place] : place;
    if (!(i >= 0 && i < here.z.length)) return;
    all(".map").forEach((other) => {  // a pixel of another camera is another ray
      const display = this.of(other).view === here.view ? "block" : "none";
      Object.assign(other.querySelector("i").style, { display, left: `${100 * (x + 0.5) / columns}%`, top: `${100 * (y + 0.5) / rows}%` });
    });
    const truth = DATA.passes[here.lightPass], material = truth.materials[truth.material[i]] || "nothing";
    const shared = DATA.instruments.filter((one) => one.view === here.view);
    const said = shared.flatMap((one, k) => [k ? " · " : "", bold(one.title), ` ${reading(one, i)}`]);
    $("probe").replaceChildren(bold(`(${i % here.width}, ${Math.floor(i / here.width)})`), ` ${material}: `, ...said);
  }
}

// Names come from the data of a result: they become text, never markup.
function bold(text) {
  const element = document.createElement("b");
  element.textContent = text;
  return element;
}

function reading(one, i) {
  const why = one.cause[i] ? ` (${DATA.causes[one.cause[i]]})` : "";
  if (!one.z[i]) return DATA.status[one.status[i]] + why;
  const z = `${(one.nearM + (one.z[i] - 1) * one.stepM).toFixed(4)} m`, mm = one.error[i] * DATA.errorStepM * 1e3;
  if (one.error[i] === -32768) return z;
  const sign = mm < 0 ? "−" : "+", size = Math.abs(mm);
  return `${z}, error ${sign}${size > 327 ? "over 327" : size.toFixed(2)} mm${why}`;
}

async function start() {
  await Promise.all(DATA.passes.map(async (one) => { one.material = await unpack(one.material, Int8Array); }));
  await Promise.all(DATA.instruments.map(unpackInstrument));
  const wanted = new URLSearchParams(location.hash.slice(1));
  const page = window.page = new Page();
  const asked = wanted.has("altitude") ? +wanted.get("altitude") : NaN, altitude = Number.isNaN(asked) ? page.levels.usual : asked;
  page.setAltitude(altitude, page.levels.level(altitude));
  if (Object.hasOwn(PAINT, wanted.get("color"))) page.setMode(wanted.get("color"));
  all("canvas.cloud").forEach((canvas) => {
    const one = page.of(canvas), drawn = one.z.reduce((n, v) => n + (v > 0), 0);
    canvas.nextElementSibling.textContent = `${drawn.toLocaleString("en")} points` + (one.hidden ? `; ${one.hidden} farther ${one.hidden === 1 ? "one" : "ones"} not drawn` : "");
  });
  page.paint();
  page.clouds.forEach((cloud) => cloud.draw());
  document.documentElement.dataset.ready = "yes";
}
start();
