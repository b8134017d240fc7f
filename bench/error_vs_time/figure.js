"use strict";
const rows = JSON.parse(document.getElementById("data").textContent), $ = id => document.getElementById(id);
const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#7f4f24", "#5e3c99", "#7a7a7a", "#66a61e", "#e7298a", "#8b0000", "#1b7f79"];
const SMALLEST = 1e-6, ALIKE = 1.15, W = 900, H = 460, LEFT = 74, STRIP = 72, RIGHT = 20, TOP = 16, BOTTOM = 44;
const unique = list => [...new Set(list)];

function fill(select, options) {
  const before = select.value;
  select.replaceChildren(...options.map(text => new Option(text, text)));
  if (options.includes(before)) select.value = before;
}

const timeText = s => s < 1e-3 ? `${(s * 1e6).toPrecision(3)} us` : s < 1 ? `${Number((s * 1e3).toPrecision(3))} ms` : `${Number(s.toPrecision(3))} s`;

function errorText(error, unit) {
  if (unit === "share" || unit === "relative") return `${Number((100 * error).toPrecision(2))} %`;
  if (unit === "m") return error < 0.01 ? `${Number((1e3 * error).toPrecision(2))} mm` : `${Number((100 * error).toPrecision(3))} cm`;
  return `${error < SMALLEST ? 0 : Number(error.toPrecision(2))} ${unit}`;
}

/** The rows that are chosen, with the error of the chosen measure. */
function chosen() {
  const measure = $("measure").value;
  return rows
    .filter(row => row.need === $("need").value && row.device === $("device").value && row.map === $("map").value && measure in row.errors)
    .map(row => ({...row, error: row.errors[measure], unit: row.units[Object.keys(row.errors).indexOf(measure)]}));
}

const rounded = row => row.error < SMALLEST ? 0 : row.error;

/** The rows that no other one beats in error and time, by rising error. */
function paretoFront(list) {
  const front = [];
  let fastest = Infinity;
  for (const row of [...list].sort((a, b) => rounded(a) - rounded(b) || a.time - b.time)) {
    if (row.time < fastest) { front.push(row); fastest = row.time; }
  }
  return front;
}

/** The most exact row within a time; of equally exact ones the fastest. */
function recommended(list, seconds) {
  return list.filter(row => row.time <= seconds).sort((a, b) => rounded(a) - rounded(b) || a.time - b.time)[0];
}

function budget(list) {
  const times = list.map(row => row.time), low = Math.log(Math.min(...times) * 0.99), high = Math.log(Math.max(...times) * 1.01);
  return Math.exp(low + (high - low) * Number($("budget").value) / 1000);
}

function element(name, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

function decades(numbers) {
  const low = Math.floor(Math.log10(Math.min(...numbers))), high = Math.ceil(Math.log10(Math.max(...numbers)));
  return [low, Math.max(high, low + 1)];
}

function tip(row, event) {
  const box = $("tip");
  box.replaceChildren();
  const lines = [
    row.name + (row.outside ? ` (${row.outside})` : ""),
    `${timeText(row.time)}; elapsed, quartiles ${row.quartiles.map(timeText).join(", ")}`,
    ...Object.entries(row.errors).map(([name, error], i) => `${name}: ${errorText(error, row.units[i])}`), row.code,
  ];
  lines.forEach((text, i) => {
    const line = document.createElement(i === lines.length - 1 ? "code" : "div");
    line.textContent = text;
    box.append(line);
  });
  box.style.display = "block";
  box.style.left = `${Math.min(event.pageX + 12, window.innerWidth - 320)}px`;
  box.style.top = `${event.pageY + 12}px`;
}

function draw() {
  const list = chosen(), figure = $("figure"), gpusense = list.filter(row => !row.outside && !row.maps);
  figure.replaceChildren();
  $("front").replaceChildren();
  if (!gpusense.length) { $("answer").textContent = "Not measured."; return; }
  const seconds = budget(gpusense), best = paretoFront(gpusense), pick = recommended(gpusense, seconds);
  $("shown").textContent = timeText(seconds);
  $("answer").textContent = pick
    ? `Within ${timeText(seconds)}: ${pick.name}, ${timeText(pick.time)}, ${errorText(pick.error, pick.unit)}. ${pick.code}`
    : `Nothing within ${timeText(seconds)}.`;
  const errors = list.map(row => row.error).filter(error => error >= SMALLEST);
  const [low, high] = decades(errors.length ? errors : [0.1]), [fast, slow] = decades(list.map(row => row.time));
  const begin = LEFT + STRIP, end = W - RIGHT, bottom = H - BOTTOM;
  const x = error => error < SMALLEST ? LEFT + STRIP / 2 : begin + (Math.log10(error) - low) / (high - low) * (end - begin);
  const y = time => bottom - (Math.log10(time) - fast) / (slow - fast) * (bottom - TOP);
  figure.append(element("rect", {x: LEFT, y: TOP, width: STRIP, height: bottom - TOP, fill: "#eef1f5"}));
  figure.append(element("text", {x: LEFT + STRIP / 2 - 10, y: bottom + 18, "text-anchor": "middle", fill: "#4a5568"}, "exact"));
  figure.append(element("text", {x: (begin + end) / 2, y: H - 6, "text-anchor": "middle"}, `${$("measure").value} [${list[0].unit}]`));
  for (let d = low; d <= high; d++) {
    const at = x(10 ** d);
    figure.append(element("path", {d: `M${at} ${TOP}V${bottom}`, stroke: "#e3e7ed"}));
    figure.append(element("text", {x: at, y: bottom + 18, "text-anchor": "middle", fill: "#4a5568"}, Number((10 ** d).toPrecision(1))));
  }
  for (let d = fast; d <= slow; d++) {
    figure.append(element("path", {d: `M${LEFT} ${y(10 ** d)}H${end}`, stroke: "#e3e7ed"}));
    figure.append(element("text", {x: LEFT - 6, y: y(10 ** d) + 4, "text-anchor": "end", fill: "#4a5568"}, timeText(10 ** d)));
  }
  const line = y(Math.min(Math.max(seconds, 10 ** fast), 10 ** slow));
  figure.append(element("path", {d: `M${LEFT} ${line}H${end}`, stroke: "#0072b2", "stroke-dasharray": "6 4"}));
  const steps = best.slice(1).map(row => `H${x(row.error)}V${y(row.time)}`).join("");
  figure.append(element("path", {d: `M${x(best[0].error)} ${y(best[0].time)}${steps}H${end}`, fill: "none", stroke: "#b8c0cc", "stroke-width": 5}));
  const methods = unique(list.map(row => row.method));
  for (const row of list) {
    const colour = COLOURS[methods.indexOf(row.method) % COLOURS.length], mine = pick && row.name === pick.name && !row.outside;
    const dot = element("circle", {
      cx: x(row.error), cy: y(row.time), r: mine ? 9 : 5, tabindex: 0, fill: row.outside ? "none" : colour,
      stroke: mine ? "#000" : row.outside ? "#7a7a7a" : colour, "stroke-width": mine || row.outside ? 2.5 : 1, "aria-label": row.name,
    });
    for (const name of ["mousemove", "click"]) dot.addEventListener(name, event => tip(row, event));
    dot.addEventListener("focus", () => { const b = dot.getBoundingClientRect(); tip(row, {pageX: b.x + window.scrollX, pageY: b.y + window.scrollY}); });
    for (const name of ["mouseleave", "blur"]) dot.addEventListener(name, () => { $("tip").style.display = "none"; });
    figure.append(dot);
  }
  const head = $("front").insertRow();
  for (const text of ["method", "time", "error", "code"]) { const cell = document.createElement("th"); cell.textContent = text; head.append(cell); }
  for (const row of best) {
    const line = $("front").insertRow();
    line.className = pick && row.name === pick.name ? "chosen" : "";
    for (const text of [row.name, timeText(row.time), errorText(row.error, row.unit), row.code]) line.insertCell().textContent = text;
  }
}

function choose() {
  const need = rows.filter(row => row.need === $("need").value);
  fill($("device"), unique(need.map(row => row.device)));
  const here = need.filter(row => row.device === $("device").value);
  fill($("map"), unique(here.map(row => row.map)).sort((a, b) => (b === "all maps") - (a === "all maps")));
  fill($("measure"), unique(here.flatMap(row => Object.keys(row.errors))));
  draw();
}

if (typeof module === "undefined") {
  fill($("need"), unique(rows.map(row => row.need)));
  if ([...$("need").options].some(option => option.value === "localisation")) $("need").value = "localisation";
  for (const id of ["need", "device", "map", "measure"]) $(id).addEventListener("change", choose);
  $("budget").addEventListener("input", draw);
  choose();
  $("check").textContent = `${rows.length} rows.`;
}
