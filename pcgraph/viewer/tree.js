"use strict";
// The segmentation tree in the browser: its cuts, its paths, and the picture of its coarsest merges.

const MAX_BRANCHES = 200;  // merges that the dendrogram shows
const SVG = "http://www.w3.org/2000/svg";

class Tree {
  static async unpack(data) {
    const tree = Object.assign(new Tree(), data);
    [tree.leaf, tree.parents, tree.altitudes, tree.sizes, tree.colors, tree.leafColors, tree.features, tree.centroids, tree.objects, tree.parts, tree.edges, tree.edgeKinds] = await Promise.all([
      unpack(data.leaf, data.wide ? Uint32Array : Uint16Array), unpack(data.parents, Int32Array), unpack(data.altitudes, Float32Array),
      unpack(data.sizes, Uint32Array), unpack(data.colors, Uint8Array), unpack(data.leafColors, Uint8Array), unpack(data.features, Float32Array),
      unpack(data.centroids, Float32Array), unpack(data.objects, Int32Array), unpack(data.parts, Int32Array), unpack(data.edges, Int32Array),
      unpack(data.edgeKinds, Uint8Array)]);
    tree.nodes = tree.parents.length;
    tree.children = new Int32Array(2 * tree.nodes).fill(-1);
    for (let node = 0; node < tree.nodes - 1; node++) {
      const at = 2 * tree.parents[node];
      tree.children[tree.children[at] < 0 ? at : at + 1] = node;
    }
    return tree;
  }

  // Number of nodes that exist once the tree is cut into so many segments.
  end(segments) { return this.nodes - segments + 1; }

  // Node that holds each leaf in the cut into so many segments.
  cut(segments) {
    const end = this.end(segments), owner = new Int32Array(end);
    for (let node = end - 1; node >= 0; node--) {
      const parent = this.parents[node];
      owner[node] = parent < end && parent !== node ? owner[parent] : node;
    }
    return owner.subarray(0, this.leaves);
  }

  // Altitude of the last merge that the cut into so many segments has done.
  altitude(segments) { return segments >= this.leaves ? 0 : this.altitudes[this.end(segments) - 1]; }

  path(leaf) {
    const nodes = [leaf];
    for (let node = leaf; this.parents[node] !== node; node = this.parents[node]) nodes.push(this.parents[node]);
    return nodes;
  }

  // Whether each leaf lies below a node, 1 or 0.
  below(node) {
    const inside = new Uint8Array(this.nodes);
    inside[node] = 1;
    for (let other = node - 1; other >= 0; other--) inside[other] = inside[this.parents[other]];
    return inside.subarray(0, this.leaves);
  }

  feature(node) {
    const count = this.featureNames.length;
    return Array.from({ length: count }, (_, i) => [this.featureNames[i], this.features[i * this.nodes + node], this.featureUnits[i]]);
  }

  color(node) { return `rgb(${this.colors.subarray(3 * node, 3 * node + 3).join(" ")})`; }
}

// Picture of the coarsest merges, root on the left; a click on a branch chooses its node.
class Dendrogram {
  constructor(svg, tree, choose) {
    Object.assign(this, { svg, tree, choose });
    this.segments = Math.min(MAX_BRANCHES + 1, tree.leaves);
    this.first = tree.end(this.segments);
    const merges = [...tree.altitudes.subarray(this.first)].filter((a) => Number.isFinite(a) && a > 0);
    this.low = Math.log(Math.min(...merges, 1) * 0.8);
    this.high = Math.log(Math.max(...merges, Math.exp(this.low) * 2));
    this.build();
  }

  // 4 .. 96 from the root to the leaves; infinite altitudes are at 4.
  across(altitude) {
    if (altitude === Infinity) return 4;
    const part = (Math.log(Math.max(altitude, Math.exp(this.low))) - this.low) / (this.high - this.low);
    return 96 - 84 * Math.min(1, part);
  }

  build() {
    const { tree } = this, root = tree.nodes - 1, y = new Float64Array(tree.nodes), order = [];
    const waiting = [root];
    while (waiting.length) {  // a node before its children, the first child's branch before the second's
      const node = waiting.pop();
      order.push(node);
      if (node >= this.first) waiting.push(tree.children[2 * node + 1], tree.children[2 * node]);
    }
    let rank = 0;
    for (const node of order) if (node < this.first) y[node] = (100 * (rank++ + 0.5)) / this.segments;
    for (const node of [...order].reverse()) if (node >= this.first) y[node] = (y[tree.children[2 * node]] + y[tree.children[2 * node + 1]]) / 2;
    this.svg.setAttribute("viewBox", "0 0 100 100");
    this.svg.setAttribute("preserveAspectRatio", "none");
    this.paths = new Map();
    const shapes = [];
    for (const node of order) {
      const right = node < this.first ? 99 : this.across(tree.altitudes[node]), left = node === root ? 1 : this.across(tree.altitudes[tree.parents[node]]);
      let d = `M${left} ${y[node]}H${right}`;
      if (node >= this.first) d += `M${right} ${y[tree.children[2 * node]]}V${y[tree.children[2 * node + 1]]}`;
      for (const name of ["hit", "branch"]) {
        const path = document.createElementNS(SVG, "path");
        path.setAttribute("d", d);
        path.classList.add(name);
        path.dataset.node = node;
        if (name === "branch") this.paths.set(node, path);
        shapes.push(path);
      }
    }
    this.line = document.createElementNS(SVG, "line");
    this.line.setAttribute("y1", 0);
    this.line.setAttribute("y2", 100);
    this.svg.replaceChildren(...shapes, this.line);
    this.svg.onclick = (e) => { if (e.target.dataset.node !== undefined) this.choose(+e.target.dataset.node); };
  }

  // Colours the branches below the cut as their segments, and moves the line.
  show(segments, chosen) {
    const { tree } = this, end = tree.end(segments), owner = new Int32Array(tree.nodes);
    for (let node = tree.nodes - 1; node >= 0; node--) {
      const parent = tree.parents[node];
      owner[node] = node >= end ? -1 : parent < end && parent !== node ? owner[parent] : node;
    }
    for (const [node, path] of this.paths) {
      path.setAttribute("stroke", owner[node] < 0 ? "#8793a3" : tree.color(owner[node]));
      path.classList.toggle("chosen", node === chosen);
    }
    const next = end < tree.nodes ? this.across(tree.altitudes[end]) : 0, done = segments >= this.segments ? 99 : this.across(tree.altitude(segments));
    const x = segments > this.segments ? 99.4 : (next + done) / 2;
    this.line.setAttribute("x1", x);
    this.line.setAttribute("x2", x);
  }
}
