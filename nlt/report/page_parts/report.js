"use strict";
// The report's charts and image viewer. Everything comes from the JSON in #data.

const $ = (id) => document.getElementById(id);
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const data = JSON.parse($("data").textContent);
const methods = new Map(data.methods.map((method) => [method.id, method]));
for (const [name, members] of Object.entries(data.curves)) for (const id of members) methods.get(id).curve = name;

const signOf = (key) => (data.quantities[key].direction === "lower" ? 1 : -1); // of a difference that is worse

function escapeText(text) {
  return String(text).replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
}

// ---- sortable tables ----

function sortTable(table, column, descending) {
  const number = (row) => (column ? parseFloat(row.cells[column].textContent.replace(/,/g, "")) : Number(row.dataset.index));
  const rows = [...table.tBodies[0].rows];
  const order = (x, y) => isNaN(x) - isNaN(y) || (descending ? y - x : x - y) || 0; // cells without a number come last
  table.tBodies[0].append(...rows.sort((p, q) => order(number(p), number(q))));
  const headings = table.tHead.rows[0].cells;
  for (const heading of headings) heading.removeAttribute("aria-sort");
  headings[column].setAttribute("aria-sort", descending ? "descending" : "ascending");
}

for (const heading of document.querySelectorAll("th[data-direction]")) {
  heading.firstElementChild.addEventListener("click", () => {
    const sorted = heading.getAttribute("aria-sort"); // the best first; at the next click, the worst
    const descending = sorted ? sorted === "ascending" : heading.dataset.direction === "higher";
    sortTable(heading.closest("table"), heading.cellIndex, descending);
  });
}

// ---- provenance of numbers; keyboard navigation as in the ARIA authoring practices for grids ----

function originOf(cell) {
  const row = cell.parentElement, table = cell.closest("table"), column = table.tHead.rows[0].cells[cell.cellIndex];
  if (row.parentElement === table.tHead) return cell.dataset.origin ?? "";
  const value = cell.cellIndex ? `, ${column.textContent}: ${cell.textContent}` : "";
  const origins = [cell, column, row, table].map((element) => element.dataset.origin);
  return [row.cells[0].textContent + value, ...origins].filter(Boolean).join("\n");
}

// Says at the bottom of the window what the pointer or the focus is on.
function tell(event) {
  const shown = ["focusin", "mouseover"].includes(event.type) && event.target.closest?.("table.grid :is(th, td), .point");
  $("origin").textContent = !shown ? "" : shown.dataset.tip ?? originOf(shown);
}
for (const type of ["mouseover", "mouseout", "focusin", "focusout"]) document.addEventListener(type, tell);
document.addEventListener("keydown", (event) => event.key === "Escape" && tell(event));

const inGrid = (cell) => cell.querySelector("button") ?? cell; // in a heading, its button has the focus
for (const table of document.querySelectorAll("table.grid")) {
  for (const row of table.rows) for (const cell of row.cells) inGrid(cell).tabIndex = -1;
  inGrid(table.rows[0].cells[0]).tabIndex = 0; // Tab enters the grid at the cell that it left last
  table.addEventListener("focusin", (event) => {
    table.querySelector("[tabindex='0']").tabIndex = -1;
    event.target.tabIndex = 0;
  });
  table.addEventListener("keydown", (event) => {
    const { cellIndex: x, parentElement: row } = event.target.closest("th, td");
    const [right, down] = [row.cells.length - 1, table.rows.length - 1], y = row.rowIndex;
    const to = {
      ArrowLeft: [x - 1, y], ArrowRight: [x + 1, y], ArrowUp: [x, y - 1], ArrowDown: [x, y + 1],
      Home: [0, event.ctrlKey ? 0 : y], End: [right, event.ctrlKey ? down : y],
    }[event.key];
    if (!to || event.altKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    const cell = table.rows[clamp(to[1], 0, down)].cells[clamp(to[0], 0, right)];
    inGrid(cell).focus();
    cell.scrollIntoView({ block: "nearest", inline: "center" }); // not hidden behind the sticky row heading
  });
}

// ---- charts ----

const plain = (x) => (Math.abs(x) >= 1e5 || (x && Math.abs(x) < 1e-3) ? x.toExponential(0) : String(+x.toPrecision(3)));

function linearTicks(low, high, count) {
  const rough = (high - low) / count, unit = 10 ** Math.floor(Math.log10(rough));
  const step = unit * [1, 2, 5, 10].find((m) => m * unit >= rough);
  const first = Math.ceil(low / step), last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, k) => (first + k) * step);
}

function logTicks(low, high) {
  const exponents = Array.from({ length: 40 }, (_, k) => k - 20);
  const between = (ticks) => ticks.filter((tick) => tick >= low && tick <= high);
  const fine = between(exponents.flatMap((e) => [1, 2, 5].map((m) => m * 10 ** e)));
  return fine.length > 9 ? between(exponents.map((e) => 10 ** e)) : fine;
}

// Returns an axis: its ticks, and a function from values to positions between the two ends.
function makeAxis([low, high], ends, count, log) {
  const scale = log ? Math.log : (x) => x;
  const share = (x) => (scale(x) - scale(low)) / (scale(high) - scale(low));
  return { at: (x) => ends[0] + share(x) * (ends[1] - ends[0]), ticks: log ? logTicks(low, high) : linearTicks(low, high, count) };
}

const gridRow = (axis, tick, [left, right]) => `<line class="grid" x1="${left}" x2="${right}" y1="${axis.at(tick)}" y2="${axis.at(tick)}"/>
  <text class="axis" x="${left - 5}" y="${axis.at(tick) + 4}" text-anchor="end">${plain(tick)}</text>`;

const gridColumn = (axis, tick, [bottom, top]) => `<line class="grid" x1="${axis.at(tick)}" x2="${axis.at(tick)}" y1="${top}" y2="${bottom}"/>
  <text class="axis" x="${axis.at(tick)}" y="${bottom + 16}" text-anchor="middle">${plain(tick)}</text>`;

// ---- speed and accuracy ----

let device = 0; // index into data.devices
const valuesOf = (method) => ({ ...method.values, ...method.times[device] });

const MARKERS = [
  "M-5,0a5,5 0 1,0 10,0a5,5 0 1,0 -10,0Z", "M-4.5,-4.5h9v9h-9Z", "M0,-6L6,0L0,6L-6,0Z", "M0,-6L5.5,4.5H-5.5Z",
  "M0,6L5.5,-4.5H-5.5Z", "M-2,-5.5h4v3.5h3.5v4h-3.5v3.5h-4v-3.5h-3.5v-4h3.5Z", "M-6,0L4.5,-5.5V5.5Z",
];
// A family's look; families of the same colour have different markers.
const look = (k) => ({ colour: `var(--c${k % 7})`, marker: MARKERS[(k + Math.floor(k / 7)) % 7], dash: ["none", "6 3", "2 3"][k % 3] });
const familyOf = (method) => method.curve ?? method.id;
const families = [...new Set(data.methods.map(familyOf))];
for (const method of data.methods) {
  const k = families.indexOf(familyOf(method));
  Object.assign(method, { number: k + 1, ...look(k) });
  method.short = method.curve ? method.setting : method.label;
}

// Returns the Pareto-optimal points, in order of cost.
function paretoFront(points, sign) {
  const front = [];
  for (const point of points.toSorted((p, q) => p.x - q.x || sign * (p.y - q.y)))
    if (!front.length || sign * point.y < sign * front.at(-1).y) front.push(point);
  return front;
}

// Returns a box [left, top, right, bottom] for each point's label, near the point and over as little else as possible.
function placeLabels(points, width, bounds) {
  const taken = points.map(({ px, py }) => [px - 7, py - 7, px + 7, py + 7]);
  const overlap = (p, q) => Math.max(0, Math.min(p[2], q[2]) - Math.max(p[0], q[0])) * Math.max(0, Math.min(p[3], q[3]) - Math.max(p[1], q[1]));
  const outside = (p) => p[0] < bounds[0] || p[1] < bounds[1] || p[2] > bounds[2] || p[3] > bounds[3];
  return points.map((point) => {
    const w = width(point), h = 13;
    const places = [[9, -h / 2], [-9 - w, -h / 2], [-w / 2, -9 - h], [-w / 2, 9], [7, -h - 5], [7, 5], [-7 - w, -h - 5], [-7 - w, 5],
      [-w / 2, -24 - h], [-w / 2, 24], [20, -30], [20, 18]];
    const boxes = places.map(([dx, dy]) => [point.px + dx, point.py + dy, point.px + dx + w, point.py + dy + h]);
    const costs = boxes.map((box, k) => taken.reduce((sum, other) => sum + overlap(box, other), k + 1e4 * outside(box)));
    const best = boxes[costs.indexOf(Math.min(...costs))];
    taken.push(best);
    return best;
  });
}

function drawChart() {
  const [xKey, yKey] = [$("chart-x").value, $("chart-y").value];
  const [xQ, yQ] = [data.quantities[xKey], data.quantities[yKey]];
  const has = (method) => yKey in valuesOf(method) && valuesOf(method)[xKey]?.[0] > 0;
  const points = data.methods.filter(has).map((method) => {
    const [y, low, high] = valuesOf(method)[yKey].slice(0, 3).map((value) => yQ.scale * value);
    return { method, x: xQ.scale * valuesOf(method)[xKey][0], y, low, high, text: valuesOf(method)[yKey][3] };
  });
  if (!points.length) {
    $("chart").innerHTML = '<p class="note">No method has both quantities.</p>';
    return;
  }
  const W = Math.max(300, $("chart").clientWidth), H = clamp(W * 0.5, 330, 480), narrow = W < 560;
  const [left, right, top, bottom] = [58, W - 14, 26, H - 40];
  const onAllDevices = data.methods.flatMap((method) => method.times.map((times) => times[xKey]?.[0] * xQ.scale)).filter((x) => x > 0);
  const shown = points.filter((p) => !yQ.far.includes(p.method.id));
  const xs = [...points.map((p) => p.x), ...onAllDevices], ys = shown.flatMap((p) => [p.low, p.high]);
  const yLog = yQ.unit === "1" && Math.min(...ys) > 0 && Math.max(...ys) / Math.min(...ys) > 20;
  const xAxis = makeAxis(padded(xs, true), [left, right], 6, true);
  const yAxis = makeAxis(padded(ys, yLog), [bottom, top], 6, yLog);
  for (const p of points) [p.px, p.py] = [xAxis.at(p.x), yAxis.at(p.y)];

  const front = paretoFront(points, signOf(yKey)), shownFront = paretoFront(shown, signOf(yKey));
  const label = ({ method }) => (narrow && !method.curve ? String(method.number) : method.short);
  const boxes = placeLabels(shown, (p) => 6.6 * label(p).length, [left, top, W, bottom]);
  const step = shownFront.map((p, k) => (k ? `H${p.px}V${p.py}` : `M${p.px},${p.py}`)).join("") + `H${right}`;
  const lines = Object.values(data.curves).map((members) => members.map((id) => shown.find((p) => p.method.id === id)).filter(Boolean));
  $("chart").innerHTML = `<svg viewBox="0 0 ${W} ${H}" role="group" aria-label="${escapeText(yQ.heading)} over ${escapeText(xQ.axis)}">
    ${xAxis.ticks.map((tick) => gridColumn(xAxis, tick, [bottom, top])).join("")}
    ${yAxis.ticks.map((tick) => gridRow(yAxis, tick, [left, right])).join("")}
    <text x="${(left + right) / 2}" y="${H - 6}" text-anchor="middle">${escapeText(xQ.axis)}, log</text>
    <text x="4" y="14">${escapeText(yQ.heading)}${yLog ? ", log" : ""}</text>
    <path d="${step}" fill="none" stroke="var(--front)" stroke-width="6" stroke-linejoin="round"/>
    ${lines.filter((line) => line.length).map(drawCurve).join("")}
    ${shown.map((p, k) => drawPoint(p, label(p), boxes[k], yAxis, xQ, yQ)).join("")}</svg>${legend(shown, narrow)}`;
  const absent = data.methods.filter((method) => !shown.some((p) => p.method === method));
  const reason = (method) => (method.status !== "ok" ? method.status : has(method) ? "far behind" : "not measured");
  const hasBars = points.some((p) => p.high > p.low);
  $("chart-note").textContent = "Grey: Pareto front. Higher is better for ↑, lower for ↓. Click on a point to show its images."
    + (hasBars ? " Bars: standard deviation over seeds or, with one seed, the 95% interval over test views." : "")
    + (absent.length ? ` Not shown: ${absent.map((m) => `${m.label} (${reason(m)})`).join(", ")}.` : "");
  $("budget").innerHTML = front.map((p) => `<li>from ${plain(p.x)} ${escapeText(xQ.unit === "1" ? "" : xQ.unit)} up:
    <button type="button" data-method="${escapeText(p.method.id)}">${escapeText(p.method.label)}</button>,
    ${escapeText(yQ.heading)} ${escapeText(p.text)}</li>`).join("");
}

function padded(values, log) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const pad = log ? (high / low) ** 0.08 * 1.08 : (high - low) * 0.09 || Math.abs(high) * 0.1 || 1;
  return log ? [low / pad, high * pad] : [low - pad, high + pad];
}

function drawCurve(points) {
  const { colour, dash } = points[0].method;
  return `<polyline points="${points.map((p) => `${p.px},${p.py}`).join(" ")}" fill="none" stroke="${colour}" stroke-width="1.5" stroke-dasharray="${dash}"/>`;
}

function drawPoint(p, label, [l, t, r], yAxis, xQ, yQ) {
  const { id, label: name, colour, marker } = p.method, [low, high] = [yAxis.at(p.low), yAxis.at(p.high)];
  const words = escapeText(`${name}\n${xQ.axis} ${plain(p.x)}\n${yQ.heading} ${p.text}`);
  const bars = p.high > p.low ? `<path d="M${p.px},${low}V${high}M${p.px - 4},${low}h8M${p.px - 4},${high}h8" stroke="${colour}" stroke-width="1.3"/>` : "";
  const isFar = Math.hypot((l + r) / 2 - p.px, t + 7 - p.py) > 20 + (r - l) / 2;
  const leader = isFar ? `<path d="M${p.px},${p.py}L${(l + r) / 2},${t + 7}" stroke="var(--faint)"/>` : "";
  return `<g class="point" role="button" tabindex="0" data-method="${escapeText(id)}" data-tip="${words}" aria-label="${words}; show its images">
    ${leader}${bars}<circle class="ring" cx="${p.px}" cy="${p.py}" r="10" fill="transparent"/>
    <path d="${marker}" transform="translate(${p.px},${p.py})" fill="${colour}" stroke="var(--paper)" stroke-width=".8"/>
    <text class="halo" x="${l}" y="${t + 11}">${escapeText(label)}</text></g>`;
}

function legend(points, narrow) {
  const listed = new Map(points.map(({ method }) => [familyOf(method), method]));
  const items = [...listed.values()].filter((method) => narrow || method.curve).map((method) => `<span>
    <svg viewBox="-8 -8 16 16" aria-hidden="true"><path d="${method.marker}" fill="${method.colour}"/></svg>
    ${escapeText(method.curve ?? `${method.number} ${method.label}`)}</span>`);
  return `<div class="key note">${items.join("")}</div>`;
}

for (const id of ["chart", "budget"]) {
  const show = (event) => {
    const method = event.target.closest("[data-method]")?.dataset.method;
    if (!kindOf.has(method)) return;
    event.preventDefault();
    set({ a: method });
    $("viewer").scrollIntoView();
    $("stage").focus({ preventScroll: true });
  };
  $(id).addEventListener("click", show);
  if (id === "chart") $(id).addEventListener("keydown", (event) => ["Enter", " "].includes(event.key) && show(event));
}

// ---- which should I use ----

let chosen = null; // the method that the section recommends

// Recommends the most accurate method within the time that the slider allows.
function choose() {
  const key = $("choose-y").value, time = "time_per_frame_s", has = (method) => key in valuesOf(method) && valuesOf(method)[time]?.[0] > 0;
  const points = data.methods.filter(has).map((method) => ({ method, x: valuesOf(method)[time][0], y: valuesOf(method)[key][0] }));
  $("choose").hidden = !points.length;
  if (!points.length) return;
  const front = paretoFront(points, signOf(key)), [fastest, slowest] = [front[0].x, front.at(-1).x];
  const limit = fastest * (slowest / fastest) ** ($("choose-time").value / 100);
  chosen = front.findLast((point) => point.x <= limit * (1 + 1e-9)).method;
  const peers = points.filter((point) => point.method !== chosen && point.x > limit).length;
  $("choose-limit").textContent = `${plain(1e3 * limit)} ms`;
  $("choose-answer").innerHTML = `<strong>${escapeText(chosen.label)}</strong>: ${valuesOf(chosen)[time][3]} s a frame,
    ${escapeText(data.quantities[key].heading)} ${escapeText(valuesOf(chosen)[key][3])}.
    ${peers ? `${peers} slower ${peers > 1 ? "methods are" : "method is"} left out.` : ""}`;
  $("choose-command").textContent = chosen.command;
  $("choose-command").hidden = !chosen.command;
  if (data.views.length) drawChosen();
}

async function drawChosen() {
  const { view, ev } = state, { id, label } = chosen, canvas = $("choose-picture");
  canvas.hidden = !kindOf.has(id);
  if (canvas.hidden) return;
  const images = await imagesOf(view);
  if (id !== chosen.id || view !== state.view) return; // another one was chosen meanwhile
  canvas.getContext("2d").drawImage(picture(images, id, ev, false), 0, 0);
  canvas.setAttribute("aria-label", `${label}, view ${data.views[view].view}`);
  canvas.dataset.drawn = id; // the tests wait for this
}

function drawStages() {
  const time = (method) => valuesOf(method).time_per_frame_s?.[0] ?? 0;
  const most = Math.max(...data.methods.map(time));
  const stages = data.stages.filter((stage) => data.methods.some((method) => valuesOf(method)[`${stage}_s`]));
  const colour = (stage) => `var(--c${stages.indexOf(stage) % 7})`, name = (stage) => stage.replace("_", " ");
  const rows = data.methods.filter(time).map((method) => {
    const values = valuesOf(method);
    const segments = stages.filter((stage) => values[`${stage}_s`]).map((stage) => {
      const [seconds, , , text] = values[`${stage}_s`];
      return `<i style="width:${(100 * seconds) / time(method)}%;background:${colour(stage)}" title="${name(stage)}: ${text} ms"></i>`;
    });
    return `<span role="listitem"><span>${escapeText(method.label)}</span><span class="row">
      <span class="segments" style="width:${(72 * time(method)) / most}%">${segments.join("")}</span>
      <span class="total">${(1e3 * time(method)).toFixed(1)} ms</span></span></span>`;
  });
  const key = stages.map((stage) => `<span><i style="background:${colour(stage)}"></i>${name(stage)}</span>`).join("");
  $("stages").innerHTML = `<span class="key" role="presentation">${key}</span>${rows.join("")}`;
}

// ---- packed images: the inverse of nlt/report/packing.py ----

// Returns an image's values, four per pixel, of which the last has no meaning.
async function unpack(url) {
  const { width: W, height: H, steps, smallest } = data;
  const picture = await createImageBitmap(await (await fetch(url)).blob(), { colorSpaceConversion: "none" });
  const context = new OffscreenCanvas(W, 2 * H).getContext("2d", { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  const high = context.getImageData(0, 0, W, H).data, low = context.getImageData(0, H, W, H).data;
  return new Float32Array(high).map((byte, i) => smallest * Math.sinh((256 * byte + low[i] - 0x8000) / steps));
}

async function unpackView(view) {
  const values = await Promise.all(data.pictures[view].map(unpack));
  return new Map(values.map((image, k) => [data.images[k].id, image]));
}

let last = { view: -1, images: null };

// Returns a promise of a view's images by id; those of the last view are kept.
function imagesOf(view) {
  if (last.view !== view) last = { view, images: unpackView(view) };
  return last.images;
}

// ---- display transform, as in nlt/display.py ----

function display(x) {
  const linear = clamp(x, 0, 1);
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
}

// Returns a canvas with an image as displayed, or its error map, at the image's resolution.
function picture(images, id, ev, error) {
  const { width: W, height: H } = data, kind = kindOf.get(id), values = images.get(id), reference = images.get("reference");
  const gain = kind === "radiance" ? 2 ** ev : 1, shown = kind === "normal" ? (x) => x : display;
  const pixels = new ImageData(W, H), out = pixels.data.fill(255);
  for (let i = 0; i < out.length; i += 4) {
    if (error && kind === "radiance") {
      const squares = [i, i + 1, i + 2].map((c) => (display(values[c]) - display(reference[c])) ** 2);
      const rms = Math.sqrt((squares[0] + squares[1] + squares[2]) / 3);
      out.set(data.colours[Math.round(255 * Math.min(rms / data.error_scale, 1))], i);
    } else for (let c = i; c < i + 3; c++) out[c] = 255 * shown(gain * values[c]);
  }
  const canvas = new OffscreenCanvas(W, H);
  canvas.getContext("2d").putImageData(pixels, 0, 0);
  return canvas;
}

// ---- the viewer ----

const kindOf = new Map(data.images.map((image) => [image.id, image.kind]));
const ids = [...kindOf.keys()];
const firstMethod = ids.find((id) => methods.has(id) && id.startsWith("nlt_photons")) ?? ids.findLast((id) => methods.has(id)) ?? ids[1];
const keys = [...($("view-key")?.options ?? [])].map((option) => option.value);
const initial = {
  view: 0, a: firstMethod ?? "reference", b: "reference", mode: "slider", front: "a", split: 0.5, zoom: 1, x: 0.5, y: 0.5, ev: 0,
  error: false, key: keys.includes("mse") ? "mse" : keys[0],
};
const state = { ...initial };
const limits = { split: [0, 1], zoom: [1, 64], x: [0, 1], y: [0, 1], ev: [-8, 8] };
const choices = { a: ids, b: ids, mode: ["slider", "flip"], front: ["a", "b"], key: keys };
let pictures = { of: "", made: new Map() };
let linkTimer = 0;

function set(change) {
  Object.assign(state, change);
  for (const [key, [low, high]] of Object.entries(limits)) state[key] = clamp(state[key], low, high);
  const edge = 0.5 / state.zoom;
  state.x = clamp(state.x, edge, 1 - edge);
  state.y = clamp(state.y, edge, 1 - edge);
  draw();
  clearTimeout(linkTimer);
  linkTimer = setTimeout(() => history.replaceState(null, "", link()), 150); // browsers limit the rate
}

function link() {
  const rounded = Object.entries(state).map(([key, value]) => [key, key in limits ? +value.toFixed(4) : value]);
  return "#" + new URLSearchParams({ ...Object.fromEntries(rounded), view: data.views[state.view].view, error: Number(state.error) });
}

// Sets the state that a link describes; missing values, or values of another report, keep their defaults.
function restore() {
  const given = new URLSearchParams(location.hash.slice(1)), change = { ...initial, error: given.get("error") === "1" };
  if (!data.views.length || !given.has("view")) return;
  change.view = Math.max(0, data.views.findIndex(({ view }) => String(view) === given.get("view")));
  for (const [key, values] of Object.entries(choices)) if (values.includes(given.get(key))) change[key] = given.get(key);
  for (const key of Object.keys(limits)) if (!isNaN(parseFloat(given.get(key)))) change[key] = parseFloat(given.get(key));
  set(change);
  $("viewer").scrollIntoView();
}

async function draw() {
  const { view, a, b, mode, front, split, zoom, x, y, ev, error } = state;
  drawControls();
  const images = await imagesOf(view);
  if (view !== state.view) return; // another view was requested meanwhile
  const of = [view, ev, error].join();
  if (pictures.of !== of) pictures = { of, made: new Map() };
  const made = (id) => {
    if (!pictures.made.has(id)) pictures.made.set(id, picture(images, id, ev, error));
    return pictures.made.get(id);
  };
  const { width: W, height: H } = data;
  const put = (id, context, canvas = context.canvas) => {
    context.imageSmoothingEnabled = false;
    context.drawImage(made(id), (x - 0.5 / zoom) * W, (y - 0.5 / zoom) * H, W / zoom, H / zoom, 0, 0, canvas.width, canvas.height);
  };
  const main = $("canvas"), wide = Math.max(1, Math.round($("stage").clientWidth * devicePixelRatio));
  if (main.width !== wide) [main.width, main.height] = [wide, Math.round((wide * H) / W)];
  const context = main.getContext("2d");
  put(mode === "flip" && front === "b" ? b : a, context);
  if (mode === "slider") {
    context.save();
    context.beginPath();
    context.rect(split * main.width, 0, main.width, main.height);
    context.clip();
    put(b, context);
    context.restore();
  }
  for (const button of $("strip").children) put(button.dataset.id, button.firstElementChild.getContext("2d"));
  if (chosen) drawChosen();
  main.dataset.drawn = JSON.stringify(state); // the tests wait for this
}

const labelOf = (id) => data.images.find((image) => image.id === id).label;
const metricsOf = (id) => data.views[state.view].metrics[id] ?? {};

function drawControls() {
  const { view, a, b, mode, front, split, zoom, ev, error, key } = state, { view: number } = data.views[view];
  for (const [id, value] of Object.entries({ view, a, b, ev, "view-key": key })) $(id).value = value;
  $("ev-value").textContent = `${ev > 0 ? "+" : ""}${ev} EV`;
  $("zoom").textContent = `${+zoom.toPrecision(3)}×`;
  for (const [id, pressed] of Object.entries({ error, flip: mode === "flip", slider: mode === "slider" })) $(id).setAttribute("aria-pressed", pressed);
  $("link").href = link();
  $("stage").classList.toggle("zoomed", zoom > 1);
  if (mode !== "slider" && document.activeElement === $("divider")) $("stage").focus({ preventScroll: true });
  $("divider").hidden = mode !== "slider";
  $("divider").style.left = `${100 * split}%`;
  $("divider").setAttribute("aria-valuenow", Math.round(100 * split));
  for (const [side, id] of [["a", a], ["b", b]]) {
    $(`corner-${side}`).textContent = `${side.toUpperCase()} ${labelOf(id)}`;
    $(`corner-${side}`).hidden = mode === "flip" && front !== side;
  }
  const seen = mode === "flip" ? labelOf(state[front]) : `${labelOf(a)} left, ${labelOf(b)} right`;
  $("canvas").setAttribute("aria-label", `View ${number}: ${seen}${error ? ", error maps" : ""}`);
  $("stage").setAttribute("aria-label", `Image viewer, view ${number}`);
  $("colour-bar").hidden = !error;
  for (const button of $("strip").children) {
    const { id } = button.dataset;
    button.classList.toggle("is-a", id === a);
    button.classList.toggle("is-b", id === b);
    button.setAttribute("aria-pressed", id === a);
    button.lastElementChild.textContent = metricsOf(id)[key]?.[1] ?? "\u00a0";
  }
  drawMetrics();
  drawViews();
}

function drawMetrics() {
  const [a, b] = [metricsOf(state.a), metricsOf(state.b)];
  $("view-metrics").innerHTML = keys.filter((key) => a[key] || b[key]).map((key) => {
    const sign = signOf(key), better = a[key] && b[key] ? sign * (b[key][0] - a[key][0]) : 0;
    const cell = (value, wins) => `<td${wins ? ' class="best"' : ""}>${value?.[1] ?? "–"}</td>`;
    return `<tr><th scope="row">${escapeText(data.quantities[key].heading)}</th>${cell(a[key], better > 0)}${cell(b[key], better < 0)}</tr>`;
  }).join("");
}

// Draws a metric of A and B for every view; a click goes to the view.
function drawViews() {
  const { key } = state, W = Math.max(260, $("views").clientWidth), H = 130, [left, top, bottom] = [44, 8, H - 22];
  const valueOf = (view, id) => view.metrics[id]?.[key]?.[0];
  const all = data.views.flatMap((view) => [valueOf(view, state.a), valueOf(view, state.b)]).filter((value) => value !== undefined);
  if (!all.length) {
    $("views").innerHTML = '<p class="note">Neither A nor B has this metric.</p>';
    return;
  }
  const axis = makeAxis([Math.min(0, ...all), Math.max(0, ...all) || 1], [bottom, top], 3);
  const wide = (W - left) / data.views.length;
  const columns = data.views.map((view, k) => {
    const x = left + (k + 0.5) * wide, [a, b] = [valueOf(view, state.a), valueOf(view, state.b)];
    return `<g data-view="${k}"><title>view ${view.view}</title>
      <rect x="${x - wide / 2}" y="0" width="${wide}" height="${bottom + 4}" fill="${k === state.view ? "var(--line)" : "transparent"}"/>
      ${a === undefined ? "" : `<circle cx="${x}" cy="${axis.at(a)}" r="3.5" fill="var(--a)"/>`}
      ${b === undefined ? "" : `<rect x="${x - 3.2}" y="${axis.at(b) - 3.2}" width="6.4" height="6.4" fill="none" stroke="var(--b)" stroke-width="1.8"/>`}</g>`;
  });
  $("views").innerHTML = `<svg viewBox="0 0 ${W} ${H}" aria-hidden="true">
    ${axis.ticks.map((tick) => gridRow(axis, tick, [left, W])).join("")}${columns.join("")}
    <text class="axis" x="${(left + W) / 2}" y="${H - 4}" text-anchor="middle">view (● A, □ B); click to go there</text></svg>`;
}

function zoomBy(factor, u = 0.5, v = 0.5) { // keeps the image's point at (u, v) of the stage in place
  const zoom = clamp(factor * state.zoom, ...limits.zoom), shift = 1 / state.zoom - 1 / zoom;
  set({ zoom, x: state.x + (u - 0.5) * shift, y: state.y + (v - 0.5) * shift });
}

const pan = (dx, dy) => set({ x: state.x + dx / state.zoom, y: state.y + dy / state.zoom });
const around = (list, now, by) => list[(list.indexOf(now) + by + list.length) % list.length];
const stepView = (by) => set({ view: (state.view + by + data.views.length) % data.views.length });
const expose = (by) => set({ ev: state.ev + by });

const ACTIONS = { // of the buttons with these ids
  previous: () => stepView(-1),
  next: () => stepView(1),
  worst: () => {
    const error = (view) => signOf(state.key) * (view.metrics[state.a]?.[state.key]?.[0] ?? NaN);
    set({ view: data.views.reduce((worst, view, k) => (error(view) > error(data.views[worst]) ? k : worst), 0) });
  },
  swap: () => set({ a: state.b, b: state.a }),
  flip: () => set(state.mode === "flip" ? { front: state.front === "a" ? "b" : "a" } : { mode: "flip", front: "b" }),
  slider: () => set({ mode: "slider" }),
  error: () => set({ error: !state.error }),
  "zoom-in": () => zoomBy(2),
  "zoom-out": () => zoomBy(0.5),
  reset: () => set({ zoom: 1, x: 0.5, y: 0.5, ev: 0 }),
  help: () => $("keys").showModal(),
};

const KEYS = {
  f: ACTIONS.flip, " ": ACTIONS.flip, s: ACTIONS.slider, d: ACTIONS.error, r: ACTIONS.reset, x: ACTIONS.swap, w: ACTIONS.worst,
  "+": ACTIONS["zoom-in"], "=": ACTIONS["zoom-in"], "-": ACTIONS["zoom-out"], _: ACTIONS["zoom-out"], "?": ACTIONS.help,
  e: (shift) => expose(shift ? -0.5 : 0.5),
  b: (shift) => set({ b: around(ids, state.b, shift ? -1 : 1) }),
  ArrowLeft: (shift) => (shift ? pan(-0.1, 0) : stepView(-1)),
  ArrowRight: (shift) => (shift ? pan(0.1, 0) : stepView(1)),
  ArrowUp: (shift) => (shift ? pan(0, -0.1) : set({ a: around(ids, state.a, -1) })),
  ArrowDown: (shift) => (shift ? pan(0, 0.1) : set({ a: around(ids, state.a, 1) })),
};

const DIVIDER_KEYS = { ArrowLeft: -0.02, ArrowDown: -0.02, ArrowRight: 0.02, ArrowUp: 0.02, PageUp: 0.1, PageDown: -0.1, Home: -1, End: 1 };

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const id = ids[/^Digit([1-9])$/.exec(event.code)?.[1] - 1], by = event.target === $("divider") && DIVIDER_KEYS[event.key];
  const action = by ? () => set({ split: state.split + by })
    : id ? (shift) => set({ [shift ? "b" : "a"]: id })
    : KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action) return;
  event.preventDefault();
  action(event.shiftKey);
}

// Returns where on the stage the pointer is, from 0 to 1.
function onStage(event) {
  const box = $("stage").getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

async function readPixel(event) {
  const { view, zoom, a, b } = state, { width: W, height: H } = data, [u, v] = onStage(event);
  const px = Math.floor((state.x + (u - 0.5) / zoom) * W), py = Math.floor((state.y + (v - 0.5) / zoom) * H);
  if (px < 0 || py < 0 || px >= W || py >= H) return;
  const images = await imagesOf(view), first = 4 * (py * W + px);
  const values = (id) => {
    const gain = kindOf.get(id) === "radiance" ? 1 / data.views[view].exposure : 1;
    return Array.from(images.get(id).subarray(first, first + 3), (x) => (gain * x).toPrecision(3)).join(" ");
  };
  const place = `pixel ${px}, ${py}`;
  $("readout").textContent = `${place}   A ${values(a)}\n${"linear".padEnd(place.length)}   B ${values(b)}`;
}

function startDrag(event) {
  if (event.button) return;
  const stage = $("stage"), split = event.target === $("divider") || (state.mode === "slider" && state.zoom === 1);
  let [u, v] = onStage(event);
  const move = (next) => {
    const [u1, v1] = onStage(next);
    if (split) set({ split: u1 });
    else pan(u - u1, v - v1);
    [u, v] = [u1, v1];
  };
  stage.setPointerCapture(event.pointerId);
  if (split) move(event);
  stage.addEventListener("pointermove", move);
  stage.addEventListener("lostpointercapture", () => stage.removeEventListener("pointermove", move), { once: true });
}

function startViewer() {
  $("viewer-body").hidden = false;
  const on = (id, event, action) => $(id).addEventListener(event, action);
  for (const [id, action] of Object.entries(ACTIONS)) on(id, "click", action);
  on("view", "change", () => set({ view: Number($("view").value) }));
  for (const [id, key] of [["a", "a"], ["b", "b"], ["view-key", "key"]]) on(id, "change", () => set({ [key]: $(id).value }));
  on("ev", "input", () => set({ ev: Number($("ev").value) }));
  on("strip", "click", (event) => {
    const id = event.target.closest("button")?.dataset.id;
    if (id) set({ [event.shiftKey ? "b" : "a"]: id });
  });
  on("views", "click", (event) => {
    const view = event.target.closest("[data-view]")?.dataset.view;
    if (view) set({ view: Number(view) });
  });
  on("stage", "keydown", onKey);
  on("stage", "pointerdown", startDrag);
  on("stage", "pointermove", readPixel);
  on("stage", "wheel", (event) => {
    if (!event.ctrlKey && !$("stage").contains(document.activeElement)) return; // the page scrolls instead
    event.preventDefault();
    zoomBy(2 ** (-Math.sign(event.deltaY) / 2), ...onStage(event));
  });
}

// ---- start ----

function drawAll() {
  drawChart();
  choose();
  drawStages();
  if (data.views.length) draw();
}

for (const id of ["chart-x", "chart-y"]) $(id).addEventListener("change", drawChart);
for (const id of ["choose-time", "choose-y"]) $(id).addEventListener("input", choose);
$("device").addEventListener("change", () => {
  device = Number($("device").value);
  drawAll();
});
if (data.views.length) startViewer();
drawAll();
restore();
addEventListener("hashchange", restore);
let width = innerWidth;
addEventListener("resize", () => {
  if (innerWidth === width) return; // a phone's address bar changes only the height
  width = innerWidth;
  drawAll();
});
