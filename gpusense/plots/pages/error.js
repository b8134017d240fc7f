"use strict";
const $ = id => document.getElementById(id), {rows, origins, text} = JSON.parse($("data").textContent);
const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "currentColor", "#7f4f24", "#5e3c99", "#7a7a7a", "#66a61e", "#e7298a", "#8b0000", "#1b7f79"];
const ALL = "all maps", SMALLEST = 1e-6, CLOSE = 1.25, ALIKE = 1.25, NARROW = typeof window !== "undefined" && window.innerWidth < 640, W = NARROW ? 460 : 900, H = 460, LEFT = 92, ANY = "any", OPENING = 0.01, STRIP = 72, RIGHT = 20, TOP = 16, BOTTOM = 44;
// Corners of the symbols of methods; none is a circle.
const SHAPES = [[], [[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]], [[0, -1], [1, 0.8], [-1, 0.8]], [[0, -1], [1, 0], [0, 1], [-1, 0]], [[0, 1], [1, -0.8], [-1, -0.8]]];
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

/** Particles and beams of a row of a filter, such as "1000 x 60"; empty texts for others. */
const sizes = row => (/^(\d+) x (\d+)/.exec(row.need === "localisation" ? row.setting : "") ?? ["", "", ""]).slice(1);

/** The path of a method's symbol. */
function symbol(methods, method, x, y, radius) {
  const corners = SHAPES[methods.indexOf(method) % SHAPES.length];
  if (!corners.length) return `M${x - radius} ${y}a${radius} ${radius} 0 1 0 ${2 * radius} 0a${radius} ${radius} 0 1 0 ${-2 * radius} 0z`;
  return `M${corners.map(([a, b]) => `${x + 1.2 * radius * a} ${y + 1.2 * radius * b}`).join("L")}z`;
}

function legend(methods) {
  $("legend").replaceChildren(...methods.map(method => {
    const item = document.createElement("li"), picture = element("svg", {viewBox: "0 0 14 14"});
    picture.append(element("path", {d: symbol(methods, method, 7, 7, 5), fill: COLOURS[methods.indexOf(method) % COLOURS.length]}));
    item.append(picture, method);
    return item;
  }));
}

/** The rows that are chosen, with the error of the chosen measure. */
function chosen() {
  const measure = $("measure").value;
  return rows
    .filter(row => row.need === $("need").value && row.device === $("device").value && row.map === ($("view").value === "profile" ? ALL : $("map").value) && measure in row.errors)
    .filter(row => ["particles", "beams"].every((id, i) => !sizes(row)[0] || $(id).value === ANY || $(id).value === sizes(row)[i]))
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

/** The most exact row within a time; of equally exact ones the fastest, of equally fast ones the first by place, as choose() of Python. */
function recommended(list, seconds) {
  const least = (rows, value) => Math.min(...rows.map(value)), able = list.filter(row => row.time <= seconds);
  const exact = able.filter(row => row.error <= CLOSE * Math.max(SMALLEST, least(able, one => one.error)));
  return exact.filter(row => row.time <= ALIKE * least(exact, one => one.time)).sort((a, b) => a.place - b.place)[0];
}

/** The steps [factor, share] of each method's performance profile (Dolan and More 2002), best first; of a method its best setting. */
function profiles(list, measure, limit) {
  const solvers = list.filter(row => row.cases.length).map(row => {
    const place = Object.keys(row.errors).indexOf(measure);
    return {row, about: row.cases.filter(([, , errors]) => errors[place] !== null).map(([name, time, errors]) => ({name, time, error: errors[place]}))};
  });
  const names = unique(solvers.flatMap(one => one.about.map(each => each.name))), best = new Map();
  const solved = about => about.filter(each => each.error <= limit);
  for (const {about} of solvers) for (const {name, time} of solved(about)) best.set(name, Math.min(time, best.get(name) ?? Infinity));
  const curves = solvers.map(({row, about}) => {
    const ratios = solved(about).map(each => each.time / best.get(each.name)).sort((a, b) => a - b);
    const mean = ratios.reduce((sum, ratio) => sum + Math.log(ratio), 0) / ratios.length;
    return {row, steps: ratios.map((ratio, i) => [ratio, (i + 1) / names.length]).filter(([ratio], i) => ratio !== ratios[i + 1]), share: ratios.length / names.length, mean};
  }).filter(curve => curve.steps.length).sort((a, b) => b.share - a.share || a.mean - b.mean);
  return {count: names.length, curves: curves.filter((curve, i) => curves.findIndex(other => other.row.method === curve.row.method && other.row.outside === curve.row.outside) === i)};
}

function budget(list) {
  const times = list.map(row => row.time), low = Math.log(Math.min(...times) * 0.99), high = Math.log(Math.max(...times) * 1.01);
  return Math.exp(low + (high - low) * Number($("budget").value) / 1000);
}

/** Set the budget to a time, as far as the slider reaches. */
function open(seconds) {
  const times = chosen().filter(row => !row.outside && !row.maps).map(row => row.time);
  if (!times.length) return;
  const low = Math.log(Math.min(...times) * 0.99), high = Math.log(Math.max(...times) * 1.01);
  $("budget").value = Math.round(1000 * Math.min(Math.max((Math.log(seconds) - low) / (high - low), 0), 1));
  draw();
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

function tip(row, event, more = []) {
  const box = $("tip");
  box.replaceChildren();
  const lines = [
    row.name + (row.outside ? ` (${row.outside})` : ""),
    `${timeText(row.time)}; elapsed, quartiles ${row.quartiles.map(timeText).join(", ")}`,
    ...Object.entries(row.errors).map(([name, error], i) => `${name}: ${errorText(error, row.units[i])}`), ...more, origins[row.origin], row.code,
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

function listen(mark, row, more) {
  for (const name of ["mousemove", "click"]) mark.addEventListener(name, event => tip(row, event, more));
  mark.addEventListener("focus", () => { const b = mark.getBoundingClientRect(); tip(row, {pageX: b.x + window.scrollX, pageY: b.y + window.scrollY}, more); });
  for (const name of ["mouseleave", "blur"]) mark.addEventListener(name, () => { $("tip").style.display = "none"; });
}

function tableOf(title, names, lines, marked) {
  $("title").textContent = title;
  $("front").replaceChildren();
  const head = $("front").insertRow();
  for (const text of names) { const cell = document.createElement("th"); cell.textContent = text; head.append(cell); }
  lines.forEach((cells, i) => {
    const line = $("front").insertRow();
    line.className = i === marked ? "chosen" : "";
    for (const text of cells) line.insertCell().textContent = text;
  });
}

/** The limit that the slider shows: between the least and the largest error of all scenes. */
function largest(errors) {
  const known = errors.filter(error => error >= SMALLEST);
  if (!known.length) return SMALLEST;
  const low = Math.log(Math.min(...known) * 0.99), high = Math.log(Math.max(...known) * 1.01);
  return Math.exp(low + (high - low) * Number($("limit").value) / 1000);
}

function drawProfile() {
  const list = chosen(), figure = $("figure"), measure = $("measure").value;
  figure.replaceChildren();
  tableOf("", [], []);
  const limit = largest(list.flatMap(row => row.cases.map(([, , errors]) => errors[Object.keys(row.errors).indexOf(measure)])).filter(error => error !== null));
  const {count, curves} = profiles(list, measure, limit);
  if (!count) { $("answer").textContent = "One scene only: a profile is about several."; $("limit-shown").textContent = ""; return; }
  $("limit-shown").textContent = errorText(limit, list[0].unit);
  const words = `${count} scene${count > 1 ? "s" : ""}, error at most ${errorText(limit, list[0].unit)}`, pick = curves.findIndex(curve => !curve.row.outside);
  $("answer").textContent = pick < 0 ? `${words}: no method.` : `${words}: ${curves[pick].row.name} solves ${Math.round(curves[pick].share * count)}, within ${Number(curves[pick].steps.at(-1)[0].toPrecision(3))} times the best time. ${curves[pick].row.code}`;
  const most = Math.max(2, ...curves.map(curve => curve.steps.at(-1)[0])), bottom = H - BOTTOM, end = W - RIGHT;
  const powers = Math.ceil(Math.log2(most) - 1e-9), x = ratio => LEFT + Math.log2(ratio) / powers * (end - LEFT), y = share => bottom - share * (bottom - TOP - 8);
  for (let d = 0; d <= powers; d += Math.ceil(powers / 10)) {
    figure.append(element("path", {d: `M${x(2 ** d)} ${TOP}V${bottom}`, class: "grid"}));
    figure.append(element("text", {x: x(2 ** d), y: bottom + 18, "text-anchor": "middle", class: "soft"}, 2 ** d));
  }
  for (const share of [0, 0.25, 0.5, 0.75, 1]) {
    figure.append(element("path", {d: `M${LEFT} ${y(share)}H${end}`, class: "grid"}));
    figure.append(element("text", {x: LEFT - 6, y: y(share) + 4, "text-anchor": "end", class: "soft"}, `${100 * share} %`));
  }
  figure.append(element("text", {x: (LEFT + end) / 2, y: H - 6, "text-anchor": "middle"}, "factor of the best time (share of scenes solved within it)"));
  const methods = unique(list.map(row => row.method));
  legend(methods);
  curves.forEach(({row, steps, share}, i) => {
    let before = 0;
    const path = steps.map(([ratio, upTo]) => { const part = `${before ? "H" : "M"}${x(ratio)}${before ? "" : ` ${y(0)}`}V${y(upTo)}`; before = upTo; return part; }).join("");
    const colour = row.outside ? "#7a7a7a" : COLOURS[methods.indexOf(row.method) % COLOURS.length];
    const line = element("path", {
      d: `${path}H${end}`, class: "curve", fill: "none", stroke: colour, "stroke-width": i === pick ? 5 : 2.5, "stroke-opacity": 0.8, tabindex: 0, "aria-label": row.name,
      ...(row.outside ? {"stroke-dasharray": "5 3"} : {}),
    });
    listen(line, row, [`solves ${Math.round(share * count)} of ${count} scenes within ${Number(steps.at(-1)[0].toPrecision(3))} times the best time`]);
    figure.append(line);
  });
  const within = curve => (curve.steps.find(([ratio]) => ratio === 1) ?? [1, 0])[1];
  tableOf("Most scenes first", ["method", "solved", "fastest in", "within times", "code"], curves.map(curve => [
    curve.row.name, `${Math.round(curve.share * count)} of ${count}`, `${Math.round(within(curve) * count)}`, curve.steps.at(-1)[0].toPrecision(3), curve.row.code,
  ]), pick);
}

function draw() {
  const profile = $("view").value === "profile";
  $("budget-label").hidden = profile;
  $("limit-label").hidden = !profile;
  $("map").closest("label").hidden = profile;
  $("figure").setAttribute("aria-label", profile ? "Share of scenes over factor of the best time" : "Time over error of each method");
  $("tip").style.display = "none";
  if (profile) drawProfile(); else drawFront();
}

function drawFront() {
  const list = chosen(), figure = $("figure"), gpusense = list.filter(row => !row.outside && !row.maps);
  figure.replaceChildren();
  tableOf("", [], []);
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
  figure.append(element("rect", {x: LEFT, y: TOP, width: STRIP, height: bottom - TOP, class: "strip"}));
  figure.append(element("text", {x: LEFT + STRIP / 2 - 10, y: bottom + 18, "text-anchor": "middle", class: "soft"}, "exact"));
  figure.append(element("text", {x: (begin + end) / 2, y: H - 6, "text-anchor": "middle"}, `${$("measure").value} [${list[0].unit}]`));
  for (let d = low; d <= high; d++) {
    const at = x(10 ** d);
    figure.append(element("path", {d: `M${at} ${TOP}V${bottom}`, class: "grid"}));
    figure.append(element("text", {x: at, y: bottom + 18, "text-anchor": "middle", class: "soft"}, Number((10 ** d).toPrecision(1))));
  }
  for (let d = fast; d <= slow; d++) {
    figure.append(element("path", {d: `M${LEFT} ${y(10 ** d)}H${end}`, class: "grid"}));
    figure.append(element("text", {x: LEFT - 6, y: y(10 ** d) + 4, "text-anchor": "end", class: "soft"}, timeText(10 ** d)));
  }
  const line = y(Math.min(Math.max(seconds, 10 ** fast), 10 ** slow));
  figure.append(element("path", {d: `M${LEFT} ${line}H${end}`, stroke: "#0072b2", "stroke-dasharray": "6 4"}));
  const steps = best.slice(1).map(row => `H${x(row.error)}V${y(row.time)}`).join("");
  figure.append(element("path", {d: `M${x(best[0].error)} ${y(best[0].time)}${steps}H${end}`, class: "front"}));
  const middle = (TOP + bottom) / 2;
  figure.append(element("text", {x: 14, y: middle, "text-anchor": "middle", transform: `rotate(-90 14 ${middle})`}, "time of a call"));
  const methods = unique(list.map(row => row.method));
  legend(methods);
  for (const row of list) {
    const colour = COLOURS[methods.indexOf(row.method) % COLOURS.length], mine = pick && row.name === pick.name && !row.outside;
    const dot = element("path", {
      d: symbol(methods, row.method, x(row.error), y(row.time), mine ? 9 : 5), class: "mark", tabindex: 0, fill: row.outside ? "none" : colour,
      stroke: mine ? "currentColor" : row.outside ? "#7a7a7a" : colour, "stroke-width": mine || row.outside ? 2.5 : 1, "aria-label": row.name,
    });
    listen(dot, row);
    figure.append(dot);
  }
  tableOf("Best for some error or time", ["method", "time", "error", "code"], best.map(row => [row.name, timeText(row.time), errorText(row.error, row.unit), row.code]), best.findIndex(row => pick && row.name === pick.name));
}

function choose() {
  const need = rows.filter(row => row.need === $("need").value);
  fill($("device"), unique(need.map(row => row.device)));
  const here = need.filter(row => row.device === $("device").value);
  fill($("map"), unique(here.map(row => row.map)).sort((a, b) => (b === ALL) - (a === ALL)));
  fill($("measure"), unique(here.flatMap(row => Object.keys(row.errors))));
  for (const [i, id] of ["particles", "beams"].entries()) {
    const known = unique(here.map(row => sizes(row)[i]).filter(text => text)).sort((a, b) => a - b);
    fill($(id), [ANY, ...known]);
    $(id).closest("label").hidden = !known.length;
  }
  draw();
}

if (typeof module === "undefined") {
  fill($("need"), unique(rows.map(row => row.need)));
  if ([...$("need").options].some(option => option.value === "localisation")) $("need").value = "localisation";
  $("figure").setAttribute("viewBox", `0 0 ${W} ${H}`);
  for (const id of ["view", "need", "device", "map", "measure", "particles", "beams"]) $(id).addEventListener("change", choose);
  for (const id of ["budget", "limit"]) $(id).addEventListener("input", draw);
  $("text").textContent = text;
  $("origins").append(...origins.map(origin => { const item = document.createElement("li"), code = document.createElement("code"); code.textContent = origin; item.append(code); return item; }));
  $("budget").value = 1000;
  choose();
  open(OPENING);
  $("check").textContent = `${rows.length} rows.`;
}
