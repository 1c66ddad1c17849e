"use strict";
// Drawing of point clouds: with WebGL through three.js, or as a still picture without it.

const BACKGROUND = [16, 21, 29];
const NO_VALUE = [122, 130, 142];  // points without a value or a supervoxel
const DIM = 0.28;  // what is left of the colours of points that are not highlighted
const TABLE_WIDTH = 1024;  // texels in a row of a table of colours
const MAX_POINT_PIXELS = 32;

// How points are coloured: by the segment of their supervoxel, by a key through a table, or by a key that is a colour.
const BY_SEGMENT = 0, BY_NUMBER = 1, BY_CATEGORY = 2, BY_COLOR = 3;

// Points that one sensor saw: they are as large as its pixels at their distance. Many of them share a pixel of the canvas.
// If the nearest were drawn, readings that are too near would hide the others. Points within this fraction of their
// distance are therefore drawn in random order.
const SPREAD = 0.01;

const POINT_VERTEX = `
precision highp float; precision highp int;
uniform mat4 modelMatrix, viewMatrix, projectionMatrix;
uniform highp sampler2D segments, table;
uniform vec4 seen;
uniform int way; uniform vec2 shown; uniform float size, least;
in vec3 position; in uint key, leaf;
out vec3 tint; out float side;
vec4 entry(highp sampler2D colors, uint i) { return texelFetch(colors, ivec2(i % ${TABLE_WIDTH}u, i / ${TABLE_WIDTH}u), 0); }
void main() {
  vec4 place = modelMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * viewMatrix * place;
  side = size / gl_Position.w;
  if (seen.w > 0.0) {
    vec3 ray = place.xyz - seen.xyz;
    float random = fract(sin(dot(place.xyz, vec3(129.898, 782.33, 377.19))) * 43758.5453);
    vec4 moved = projectionMatrix * viewMatrix * vec4(seen.xyz + ray * (1.0 - 0.5 * ${SPREAD} + ${SPREAD} * random), 1.0);
    gl_Position.z = moved.z / moved.w * gl_Position.w;
    side *= length(ray);
  }
  side = clamp(side, least, ${MAX_POINT_PIXELS}.0);
  gl_PointSize = side;
  vec4 segment = entry(segments, leaf);
  if (way == ${BY_SEGMENT}) tint = segment.rgb;
  else if (way == ${BY_CATEGORY}) tint = entry(table, key).rgb;
  else if (way == ${BY_COLOR}) tint = vec3((key >> 16u) & 255u, (key >> 8u) & 255u, key & 255u) / 255.0;
  else tint = entry(table, key == 0u ? 0u : 1u + uint(255.0 * clamp((float(key) - shown.x) / (shown.y - shown.x), 0.0, 1.0) + 0.5)).rgb;
  tint *= segment.a;
}`;
const POINT_FRAGMENT = `
precision highp float;
uniform vec4 seen; in vec3 tint; in float side; out vec4 pixel;
void main() {
  vec2 from = gl_PointCoord - 0.5;
  if (seen.w == 0.0 && side > 4.0 && dot(from, from) > 0.25) discard;
  pixel = vec4(tint, 1.0);
}`;

const SCREEN_VERTEX = `
in vec3 position;
void main() { gl_Position = vec4(position, 1.0); }`;
// Eye-dome lighting (Boucheny 2009): a pixel darkens by how far it lies behind its neighbours, in logarithms of depth.
const SCREEN_FRAGMENT = `
precision highp float;
uniform highp sampler2D color, depth;
uniform vec2 range; uniform float strength, reach, parallel, slack; uniform vec3 background;
out vec4 pixel;
float away(ivec2 at) {
  float d = texelFetch(depth, at, 0).r;
  return parallel > 0.5 ? mix(range.x, range.y, d) : range.x * range.y / (range.y - d * (range.y - range.x));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), last = textureSize(depth, 0) - 1;
  float d = texelFetch(depth, at, 0).r;
  gl_FragDepth = d;
  if (d >= 1.0) { pixel = vec4(background, 1.0); return; }
  float shade = 1.0;
  if (strength > 0.0) {
    float own = log2(away(at)) - log2(1.0 + slack / away(at)), sum = 0.0;  // less than a point's size is no step
    int r = int(reach);
    ivec2 near[8] = ivec2[8](ivec2(r, 0), ivec2(-r, 0), ivec2(0, r), ivec2(0, -r), ivec2(r, r), ivec2(-r, r), ivec2(r, -r), ivec2(-r, -r));
    for (int i = 0; i < 8; i++) sum += clamp(own - log2(away(clamp(at + near[i], ivec2(0), last))), 0.0, 0.04);
    shade = exp(-strength * sum);
  }
  pixel = vec4(texelFetch(color, at, 0).rgb * shade, 1.0);
}`;

// A line is a strip as wide as `width` pixels: each end is there twice, once for each side.
const LINE_VERTEX = `
precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix; uniform vec2 screen; uniform float width, lift;
in vec3 position, other, color; in float side;
out vec3 tint;
vec4 place(vec3 at) {  // nearer to the viewer by lift metres, so that points on the line do not hide it
  vec3 seen = (modelViewMatrix * vec4(at, 1.0)).xyz;
  if (projectionMatrix[2][3] == 0.0) seen.z += lift; else seen *= 1.0 - min(0.5, lift / length(seen));
  return projectionMatrix * vec4(seen, 1.0);
}
void main() {
  gl_Position = place(position);
  vec4 end = place(other);
  vec2 along = (end.xy / end.w - gl_Position.xy / gl_Position.w) * screen;
  vec2 across = normalize(vec2(-along.y, along.x) + vec2(1e-9, 0.0));
  gl_Position.xy += side * width * across / screen * gl_Position.w;
  tint = color;
}`;
const LINE_FRAGMENT = `
precision highp float;
uniform float opacity; in vec3 tint; out vec4 pixel;
void main() { pixel = vec4(tint, opacity); }`;

async function unpack(text, Type) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Type(await new Response(stream).arrayBuffer());
}

// Sets the canvas to the size at which it is shown; returns this size in pixels.
function fit(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  return [width, height];
}

// Table of colours as a texture's bytes: RGBA, in rows of TABLE_WIDTH.
function tableBytes(entries) { return new Uint8Array(4 * TABLE_WIDTH * Math.max(1, Math.ceil(entries / TABLE_WIDTH))).fill(255); }

// What colours points: `segments` is a table with an entry per supervoxel, 1 + its number, whose alpha dims; `key` is one
// number per point, `table` what it stands for, and `shown` the keys at the ends of the colour bar.
function painting(leaves) {
  const segments = tableBytes(leaves + 1);
  segments.set([...NO_VALUE, 255], 0);
  return { way: BY_COLOR, segments, key: null, table: tableBytes(1), shown: [0, 1] };
}

// Keys that are colours, of three bytes per point.
function colorKeys(bytes) {
  const keys = new Uint32Array(bytes.length / 3);
  for (let i = 0; i < keys.length; i++) keys[i] = bytes[3 * i] << 16 | bytes[3 * i + 1] << 8 | bytes[3 * i + 2];
  return keys;
}

// Colour of a point, as the vertex shader finds it.
function colorOf(paint, leaf, i) {
  const { way, segments, key, table, shown } = paint, k = key ? key[i] : 0;
  let from = segments, at = 4 * leaf[i];
  const left = segments[at + 3] / 255;
  if (way === BY_COLOR) return [((k >> 16) & 255) * left, ((k >> 8) & 255) * left, (k & 255) * left];
  if (way !== BY_SEGMENT) {
    from = table;
    const part = Math.max(0, Math.min(1, (k - shown[0]) / (shown[1] - shown[0])));
    at = 4 * (way === BY_CATEGORY || k === 0 ? k : 1 + Math.round(255 * part));
  }
  return [from[at] * left, from[at + 1] * left, from[at + 2] * left];
}

// Order of n points of which every beginning is spread over all: every 16th point, then those between, and so on.
function thinningOrder(n) {
  const order = new Uint32Array(n);
  let k = 0;
  for (const first of [0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15]) for (let i = first; i < n; i += 16) order[k++] = i;
  return order;
}

// Near and far planes that hold a ball around a centre, as seen by a camera.
function setPlanes(camera, centre, radius) {
  const away = camera.position.distanceTo(centre);
  camera.near = Math.max(away - radius, 0.004 * Math.min(away, radius));
  camera.far = away + radius;
  camera.updateProjectionMatrix();
  camera.updateMatrixWorld();
}

// Size of a point of a size in metres: pixels times the fourth component of its place on the screen.
function pixelsPerMetre(camera, height) { return camera.projectionMatrix.elements[5] * height / 2; }

// A cloud as drawing needs it: `steps`, 3 numbers per point, the size of a `step` and the place of step 0, `corner`, in the
// view's frame; `leaf`, 1 + the supervoxel of each point or 0; and `seenFrom`, the place of a sensor whose pixels the points
// are, if they are.
class PointScene {
  constructor(canvas, context) {
    Object.assign(this, { canvas, lines: [], shading: true });
    this.renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true });
    this.renderer.autoClear = false;
    this.scene = new THREE.Scene();
    this.overlay = new THREE.Scene();
    this.target = new THREE.WebGLRenderTarget(1, 1, { minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter });
    this.target.depthTexture = new THREE.DepthTexture(1, 1, THREE.UnsignedIntType);
    this.screen = this.fullScreen();
  }

  fullScreen() {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: SCREEN_VERTEX, fragmentShader: SCREEN_FRAGMENT, depthFunc: THREE.AlwaysDepth,
      uniforms: {
        color: { value: this.target.texture }, depth: { value: this.target.depthTexture }, range: { value: [1, 2] }, parallel: { value: 0 },
        strength: { value: 0 }, reach: { value: 1 }, slack: { value: 0 }, background: { value: BACKGROUND.map((c) => c / 255) },
      },
    });
    const mesh = new THREE.Mesh(geometry, material), scene = new THREE.Scene();
    mesh.frustumCulled = false;
    scene.add(mesh);
    return { scene, uniforms: material.uniforms };
  }

  show(cloud) {
    if (this.points) { this.scene.remove(this.points); this.points.geometry.dispose(); this.points.material.dispose(); }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(cloud.steps, 3));
    geometry.setAttribute("leaf", new THREE.BufferAttribute(cloud.leaf, 1));
    geometry.setAttribute("key", new THREE.BufferAttribute(new Uint32Array(cloud.leaf.length), 1));
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: POINT_VERTEX, fragmentShader: POINT_FRAGMENT,
      uniforms: {
        segments: { value: null }, table: { value: null }, way: { value: BY_COLOR }, shown: { value: [0, 1] },
        size: { value: 1 }, least: { value: 1 }, seen: { value: cloud.seenFrom ? [...cloud.seenFrom, 1] : [0, 0, 0, 0] },
      },
    });
    geometry.setIndex(new THREE.BufferAttribute(thinningOrder(cloud.leaf.length), 1));
    this.key = null;
    this.points = new THREE.Points(geometry, material);
    this.points.frustumCulled = false;
    this.points.scale.fromArray(cloud.step);
    this.points.position.fromArray(cloud.corner);
  }

  // Takes up a painting whose arrays have changed; the points stay on the graphics card.
  paint(paint) {
    const { geometry, material } = this.points, { uniforms } = material;
    if (paint.key && this.key !== paint.key) {
      geometry.attributes.key.array.set(paint.key);
      geometry.attributes.key.needsUpdate = true;
      this.key = paint.key;
    }
    if (!this.points.parent) this.scene.add(this.points);
    for (const name of ["segments", "table"]) {
      const texture = uniforms[name].value;
      if (texture?.image.data === paint[name]) { texture.needsUpdate = true; continue; }
      texture?.dispose();
      const fresh = new THREE.DataTexture(paint[name], TABLE_WIDTH, paint[name].length / 4 / TABLE_WIDTH);
      fresh.needsUpdate = true;
      uniforms[name].value = fresh;
    }
    uniforms.way.value = paint.way;
    uniforms.shown.value = paint.shown;
  }

  // Lines between pairs of places, 6 numbers each, with a colour of 3 numbers 0..1 for each pair.
  addLines(places, colors, { width = 1.5, opacity = 1, hidden = true, lift = 0 } = {}) {
    const count = colors.length / 3, ends = new Float32Array(12 * count), others = new Float32Array(12 * count);
    const tints = new Float32Array(12 * count), sides = new Float32Array(4 * count), corners = new Uint32Array(6 * count);
    for (let i = 0; i < count; i++) {
      const a = places.subarray(6 * i, 6 * i + 3), b = places.subarray(6 * i + 3, 6 * i + 6);
      [[a, b, 1], [a, b, -1], [b, a, -1], [b, a, 1]].forEach(([end, other, side], j) => {
        const k = 4 * i + j;
        ends.set(end, 3 * k);
        others.set(other, 3 * k);
        tints.set(colors.subarray(3 * i, 3 * i + 3), 3 * k);
        sides[k] = side;
      });
      corners.set([0, 1, 2, 2, 1, 3].map((c) => 4 * i + c), 6 * i);
    }
    const geometry = new THREE.BufferGeometry();
    const fill = (name, array, size) => geometry.setAttribute(name, new THREE.BufferAttribute(array, size));
    fill("position", ends, 3);
    fill("other", others, 3);
    fill("color", tints, 3);
    fill("side", sides, 1);
    geometry.setIndex(new THREE.BufferAttribute(corners, 1));
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: LINE_VERTEX, fragmentShader: LINE_FRAGMENT, transparent: opacity < 1,
      depthTest: hidden, depthWrite: hidden, side: THREE.DoubleSide,
      uniforms: { screen: { value: [1, 1] }, width: { value: width }, opacity: { value: opacity }, lift: { value: lift } },
    });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    this.overlay.add(mesh);
    return mesh;
  }

  removeLines(mesh) {
    if (!mesh) return;
    this.overlay.remove(mesh);
    mesh.geometry.dispose();
    mesh.material.dispose();
  }

  // camera: one of three.js; size: pixels of a point at w = 1 (of one that a sensor saw, at 1 m from it); least: pixels of the
  // smallest point; slack: steps in depth, in metres, that the shading leaves out; part: fraction of the points to draw
  draw(camera, size, least, slack = 0, part = 1) {
    const { renderer, target } = this, ratio = Math.min(window.devicePixelRatio || 1, 2), [width, height] = fit(this.canvas);
    if (!(width && height && this.points)) return;
    renderer.setViewport(0, 0, width, height);
    if (target.width !== width || target.height !== height) target.setSize(width, height);
    const uniforms = this.points.material.uniforms;
    this.points.geometry.setDrawRange(0, Math.ceil(part * this.points.geometry.index.count));
    uniforms.size.value = size / Math.sqrt(part);  // so that fewer points cover as much
    uniforms.least.value = least * ratio;
    Object.assign(this.screen.uniforms, {
      range: { value: [camera.near, camera.far] }, parallel: { value: camera.isOrthographicCamera ? 1 : 0 },
      strength: { value: this.shading ? 11 : 0 }, reach: { value: Math.max(1, Math.round(ratio)) }, slack: { value: slack },
    });
    for (const { material } of this.overlay.children) material.uniforms.screen.value = [width, height];
    renderer.setRenderTarget(target);
    renderer.setClearColor(0, 1);
    renderer.clear();
    renderer.render(this.scene, camera);
    renderer.setRenderTarget(null);
    renderer.render(this.screen.scene, camera);
    renderer.render(this.overlay, camera);
  }
}

// A still picture of a cloud, drawn without WebGL; the same calls as of a PointScene.
class StillScene {
  constructor(canvas) {
    this.canvas = canvas;
    canvas.classList.add("still");
  }

  show(cloud) { this.cloud = cloud; }

  paint(paint) { this.painting = paint; }

  addLines() { return null; }

  removeLines() {}

  draw(camera, size, least) {
    const [width, height] = fit(this.canvas), { steps, step, corner, leaf, seenFrom } = this.cloud;
    if (!(width && height)) return;
    const m = screenMatrix(camera, step, corner), sensor = seenFrom?.map((c, a) => (c - corner[a]) / step[a]);
    const context = this.canvas.getContext("2d"), image = context.createImageData(width, height);
    const nearest = new Float32Array(width * height).fill(Infinity), pixels = new Uint32Array(image.data.buffer);
    const packed = ([r, g, b]) => (255 << 24) | (b << 16) | (g << 8) | r;  // of a little-endian machine
    pixels.fill(packed(BACKGROUND));
    for (let i = 0, k = 0; i < leaf.length; i++, k += 3) {
      const x = steps[k], y = steps[k + 1], z = steps[k + 2], w = m[3] * x + m[7] * y + m[11] * z + m[15];
      if (w <= 0) continue;
      let side = size / w, depth = (m[2] * x + m[6] * y + m[10] * z + m[14]) / w;
      if (sensor) {
        const by = 1 - 0.5 * SPREAD + SPREAD * (i * 0.618033988749895 % 1);
        const [u, v, t] = [sensor[0] + by * (x - sensor[0]), sensor[1] + by * (y - sensor[1]), sensor[2] + by * (z - sensor[2])];
        depth = (m[2] * u + m[6] * v + m[10] * t + m[14]) / (m[3] * u + m[7] * v + m[11] * t + m[15]);
        side *= Math.hypot((x - sensor[0]) * step[0], (y - sensor[1]) * step[1], (z - sensor[2]) * step[2]);
      }
      side = Math.max(least, Math.min(MAX_POINT_PIXELS, side));
      const left = (0.5 + 0.5 * (m[0] * x + m[4] * y + m[8] * z + m[12]) / w) * width - side / 2;
      const top = (0.5 - 0.5 * (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) * height - side / 2;
      const color = packed(colorOf(this.painting, leaf, i));
      const right = Math.min(width, Math.round(left + side)), bottom = Math.min(height, Math.round(top + side));
      for (let v = Math.max(0, Math.round(top)); v < bottom; v++) {
        for (let u = Math.max(0, Math.round(left)); u < right; u++) {
          if (depth >= nearest[v * width + u]) continue;
          nearest[v * width + u] = depth;
          pixels[v * width + u] = color;
        }
      }
    }
    context.putImageData(image, 0, 0);
  }
}

// Matrix from steps to the screen (-1..1), column by column.
function screenMatrix(camera, step, corner) {
  const from = new THREE.Matrix4().makeScale(...step).setPosition(...corner);
  return new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).multiply(from).elements;
}

// Point under a place of the canvas, in pixels of CSS: the nearest to the viewer within `reach` pixels; -1 for none.
function pointAt(cloud, camera, canvas, left, top, reach) {
  const m = screenMatrix(camera, cloud.step, cloud.corner), { steps } = cloud, w2 = canvas.clientWidth / 2, h2 = canvas.clientHeight / 2;
  let best = -1, least = Infinity;
  for (let i = 0, k = 0; k < steps.length; i++, k += 3) {
    const x = steps[k], y = steps[k + 1], z = steps[k + 2], w = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (w <= 0) continue;
    const dx = (1 + (m[0] * x + m[4] * y + m[8] * z + m[12]) / w) * w2 - left;
    const dy = (1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) * h2 - top;
    if (dx * dx + dy * dy > reach * reach) continue;
    const depth = (m[2] * x + m[6] * y + m[10] * z + m[14]) / w;
    if (depth < least && depth >= -1) { least = depth; best = i; }
  }
  return best;
}

// A scene that draws with WebGL, or a still one.
function openScene(canvas) {
  const context = canvas.getContext("webgl2", { antialias: true, alpha: false, preserveDrawingBuffer: false });
  if (context) return new PointScene(canvas, context);
  const fresh = canvas.cloneNode();  // a canvas that was asked for WebGL may refuse a 2D context
  canvas.replaceWith(fresh);
  return new StillScene(fresh);
}
