"use strict";
// Boxes: along the principal axes of points, and the lines that draw one.

// Axes of a symmetric matrix, largest first, by Jacobi's rotations; m holds xx, xy, xz, yy, yz, zz.
function principalAxes([xx, xy, xz, yy, yz, zz]) {
  const a = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], v = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < 12; sweep++) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      if (Math.abs(a[p][q]) < 1e-300) continue;
      const theta = (a[q][q] - a[p][p]) / (2 * a[p][q]), t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
      const c = 1 / Math.sqrt(t * t + 1), s = t * c;
      for (let k = 0; k < 3; k++) [a[k][p], a[k][q]] = [c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]];
      for (let k = 0; k < 3; k++) [a[p][k], a[q][k]] = [c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]];
      for (let k = 0; k < 3; k++) [v[k][p], v[k][q]] = [c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]];
    }
  }
  return [0, 1, 2].sort((i, j) => a[j][j] - a[i][i]).map((i) => [v[0][i], v[1][i], v[2][i]]);
}

// Box along the principal axes of those points of a cloud whose supervoxels are chosen, in the view's frame; null for none.
function principalBox(cloud, chosen) {
  const { steps, step, corner, leaf } = cloud, mean = [0, 0, 0], m = [0, 0, 0, 0, 0, 0], p = [0, 0, 0];
  const visit = (act) => {
    for (let i = 0; i < leaf.length; i++) {
      if (!leaf[i] || !chosen[leaf[i] - 1]) continue;
      for (let a = 0; a < 3; a++) p[a] = corner[a] + step[a] * steps[3 * i + a];
      act();
    }
  };
  let count = 0;
  visit(() => { count++; for (let a = 0; a < 3; a++) mean[a] += p[a]; });
  if (!count) return null;
  for (let a = 0; a < 3; a++) mean[a] /= count;
  visit(() => {
    const [x, y, z] = [p[0] - mean[0], p[1] - mean[1], p[2] - mean[2]];
    m[0] += x * x; m[1] += x * y; m[2] += x * z; m[3] += y * y; m[4] += y * z; m[5] += z * z;
  });
  const axes = principalAxes(m), low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  visit(() => {
    for (let a = 0; a < 3; a++) {
      const along = axes[a][0] * (p[0] - mean[0]) + axes[a][1] * (p[1] - mean[1]) + axes[a][2] * (p[2] - mean[2]);
      low[a] = Math.min(low[a], along);
      high[a] = Math.max(high[a], along);
    }
  });
  const center = mean.map((c, i) => c + axes.reduce((sum, axis, a) => sum + axis[i] * (low[a] + high[a]) / 2, 0));
  return { center, axes, size: high.map((h, a) => h - low[a]) };
}

// Ends of the 12 edges of a box, 6 numbers each.
function boxEdges({ center, axes, size }) {
  const corner = (signs) => center.map((c, i) => c + signs.reduce((sum, s, a) => sum + s * size[a] / 2 * axes[a][i], 0));
  const ends = [];
  for (let a = 0; a < 3; a++) {
    for (const [u, v] of [[-1, -1], [-1, 1], [1, -1], [1, 1]]) {
      for (const s of [-1, 1]) {
        const signs = [u, v];
        signs.splice(a, 0, s);
        ends.push(...corner(signs));
      }
    }
  }
  return ends;
}
