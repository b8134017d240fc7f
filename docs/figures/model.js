// The beam model and the likelihood field (Probabilistic Robotics, sections 6.3 and 6.4), as gpusense computes them.
// Lengths are in metres, angles in radians. A test compares each function with gpusense's NumPy backend.
"use strict";

// The error function: its series near 0, a continued fraction beyond.
function erf(x) {
  const a = Math.abs(x);
  if (a > 6) return Math.sign(x);
  if (a < 2.5) {
    let term = x, sum = x;
    for (let n = 1; Math.abs(term) > 1e-17 * Math.abs(sum); n++) {
      term *= -x * x / n;
      sum += term / (2 * n + 1);
    }
    return 2 / Math.sqrt(Math.PI) * sum;
  }
  let fraction = 0;
  for (let k = 80; k > 0; k--) fraction = k / 2 / (a + fraction);
  return Math.sign(x) * (1 - Math.exp(-a * a) / Math.sqrt(Math.PI) / (a + fraction));
}

// The four causes of a reading z < rangeMax, each times its weight [1/m]; z_max is a probability of its own.
function densities(z, expected, rangeMax, p) {
  const off = (z - expected) / p.sigma_hit, scale = p.sigma_hit * Math.SQRT2;
  const mass = 0.5 * (erf(expected / scale) + erf((rangeMax - expected) / scale));
  const hit = p.z_hit * Math.exp(-0.5 * off * off) / (p.sigma_hit * Math.sqrt(2 * Math.PI)) / mass;
  let short = 0;
  if (z <= expected && expected > 0) {
    const x = p.lambda_short * expected;
    short = p.z_short * Math.exp(-p.lambda_short * z) * (x > 0 ? p.lambda_short / -Math.expm1(-x) : 1 / expected);
  }
  const rand = p.z_rand / rangeMax;
  return {hit, short, rand, sum: hit + short + rand};
}

// map: {cols, rows, resolution, cells}, cells row by row from the lowest; 1 is occupied.
function occupied(map, col, row) {
  return col >= 0 && row >= 0 && col < map.cols && row < map.rows && map.cells[row * map.cols + col] === 1;
}

// The distance from (x, y) along an angle to the first occupied cell, rangeMax where none is nearer: the walk of
// Amanatides and Woo (1987).
function castRay(map, x, y, angle, rangeMax) {
  const u = x / map.resolution, v = y / map.resolution, limit = rangeMax / map.resolution;
  const c = Math.cos(angle), s = Math.sin(angle);
  let col = Math.floor(u), row = Math.floor(v), t = 0, i = 0, j = 0;
  const a = c > 0 ? col + 1 - u : u - col, b = s > 0 ? row + 1 - v : v - row;
  while (t < limit) {
    if (occupied(map, col, row)) return t * map.resolution;
    const alongX = c === 0 ? Infinity : (i + a) / Math.abs(c), alongY = s === 0 ? Infinity : (j + b) / Math.abs(s);
    t = Math.min(alongX, alongY);
    if (alongX <= alongY) { i++; col += c > 0 ? 1 : -1; } else { j++; row += s > 0 ? 1 : -1; }
  }
  return rangeMax;
}

// The distance of each cell's centre to the nearest occupied centre, most at farthest.
function distances(map, farthest) {
  const out = new Float64Array(map.cols * map.rows).fill(farthest), reach = Math.ceil(farthest / map.resolution);
  for (let row = 0; row < map.rows; row++) for (let col = 0; col < map.cols; col++) {
    if (!occupied(map, col, row)) continue;
    for (let v = Math.max(row - reach, 0); v <= Math.min(row + reach, map.rows - 1); v++)
      for (let u = Math.max(col - reach, 0); u <= Math.min(col + reach, map.cols - 1); u++) {
        const d = map.resolution * Math.hypot(u - col, v - row), k = v * map.cols + u;
        if (d < out[k]) out[k] = d;
      }
  }
  return out;
}

function expectedRanges(map, pose, scan) {
  return scan.bearings.map(bearing => castRay(map, pose[0], pose[1], pose[2] + bearing, scan.range_max));
}

// log p(z | x, m) of a scan by the beam model; null readings are those without a return.
function logBeam(map, pose, scan, p) {
  return expectedRanges(map, pose, scan).reduce((sum, expected, k) => sum + Math.log(
    scan.ranges[k] === null ? p.z_max : densities(scan.ranges[k], expected, scan.range_max, p).sum), 0);
}

// log p(z | x, m) of a scan by the likelihood field, whose distances are far beyond the map; readings without a return
// are left out.
function logField(map, far, pose, scan, p) {
  const peak = p.z_hit / (p.sigma_hit * Math.sqrt(2 * Math.PI));
  return scan.bearings.reduce((sum, bearing, k) => {
    const z = scan.ranges[k];
    if (z === null) return sum;
    const col = Math.floor((pose[0] + z * Math.cos(pose[2] + bearing)) / map.resolution);
    const row = Math.floor((pose[1] + z * Math.sin(pose[2] + bearing)) / map.resolution);
    const inside = col >= 0 && row >= 0 && col < map.cols && row < map.rows;
    const d = (inside ? far[row * map.cols + col] : p.max_distance) / p.sigma_hit;
    return sum + Math.log(peak * Math.exp(-0.5 * d * d) + p.z_rand / scan.range_max);
  }, 0);
}

// The probability of each cause of a reading, z* being the same for all; null is a reading without a return.
function causes(z, expected, rangeMax, p) {
  if (z === null) return {hit: 0, short: 0, max: 1, rand: 0, sum: p.z_max};
  const d = densities(z, expected, rangeMax, p);
  return {hit: d.hit / d.sum, short: d.short / d.sum, max: 0, rand: d.rand / d.sum, sum: d.sum};
}

// The log-likelihood of readings.
function logReadings(ranges, expected, rangeMax, p) {
  return ranges.reduce((sum, z) => sum + Math.log(causes(z, expected, rangeMax, p).sum), 0);
}

// One step of EM as the book prints it (table 6.2).
function emStep(ranges, expected, rangeMax, p) {
  const total = {hit: 0, short: 0, max: 0, rand: 0};
  let square = 0, length = 0;
  for (const z of ranges) {
    const share = causes(z, expected, rangeMax, p);
    for (const name in total) total[name] += share[name];
    if (z !== null) { square += share.hit * (z - expected) ** 2; length += share.short * z; }
  }
  const n = ranges.length;
  return {z_hit: total.hit / n, z_short: total.short / n, z_max: total.max / n, z_rand: total.rand / n,
    sigma_hit: Math.sqrt(square / total.hit), lambda_short: total.short / length};
}

// Cells out of a string of 0 and 1.
function unpacked(map) {
  return {...map, cells: Uint8Array.from(map.cells, Number)};
}

// The largest relative difference between these functions and the values of gpusense in a page.
function disagreement(data) {
  let worst = 0;
  const compare = (a, b) => { worst = Math.max(worst, Math.abs(a - b) / Math.max(Math.abs(b), 1e-3)); };
  for (const one of data.densities || [])
    one.z.forEach((z, k) => compare(densities(z, one.expected, data.range_max, one.parameters).sum, one.p[k]));
  if (data.poses) {
    const map = unpacked(data.map), far = distances(map, data.field.max_distance);
    for (const one of data.poses) {
      expectedRanges(map, one.pose, data.scan).forEach((t, k) => compare(t, one.expected[k]));
      compare(logBeam(map, one.pose, data.scan, data.beam), one.log_beam);
      compare(logField(map, far, one.pose, data.scan, data.field), one.log_field);
    }
  }
  if (data.steps) {
    let p = data.start, done = 0;
    for (const one of data.steps) {
      for (; done < one.count; done++) p = emStep(data.ranges, data.expected, data.range_max, p);
      for (const name in one.parameters) compare(p[name], one.parameters[name]);
      compare(logReadings(data.ranges, data.expected, data.range_max, p), one.log_likelihood);
    }
  }
  return worst;
}
