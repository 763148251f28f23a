"use strict";
// The report's charts and image viewer. Everything comes from the JSON in #data and the packed images in #images-N.

const $ = (id) => document.getElementById(id);
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const data = JSON.parse($("data").textContent);
const methods = new Map(data.methods.map((method) => [method.id, method]));
for (const [name, members] of Object.entries(data.curves)) for (const id of members) methods.get(id).curve = name;

function escapeText(text) {
  return String(text).replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);
}

function fill(select, options) {
  select.innerHTML = options.map(([value, text]) => `<option value="${escapeText(value)}">${escapeText(text)}</option>`).join("");
}

// ---- sortable tables ----

const number = (text) => parseFloat(text.replace(/,/g, "")); // the number at the start of a cell; NaN if there is none

function sortTable(table, column, descending) {
  const key = (row) => (column ? number(row.cells[column].textContent) : Number(row.dataset.index));
  const rows = [...table.tBodies[0].rows].map((row) => [key(row), row]);
  const sign = descending ? -1 : 1;
  rows.sort(([x], [y]) => isNaN(x) - isNaN(y) || sign * (x - y) || 0); // cells without a number come last
  table.tBodies[0].append(...rows.map(([, row]) => row));
  for (const heading of table.tHead.rows[0].cells) heading.removeAttribute("aria-sort");
  table.tHead.rows[0].cells[column].setAttribute("aria-sort", descending ? "descending" : "ascending");
}

for (const heading of document.querySelectorAll("th[data-direction]")) {
  heading.firstElementChild.addEventListener("click", () => {
    const sorted = heading.getAttribute("aria-sort"); // the best first; at the next click, the worst
    const descending = sorted ? sorted === "ascending" : heading.dataset.direction === "higher";
    sortTable(heading.closest("table"), heading.cellIndex, descending);
  });
}

// ---- provenance of numbers; keyboard navigation as in the ARIA authoring practices for grids ----

const said = (element) => element.dataset.origin ?? "";

function originOf(cell) {
  const row = cell.parentElement, table = cell.closest("table"), column = table.tHead.rows[0].cells[cell.cellIndex];
  if (row.parentElement === table.tHead) return said(cell);
  const what = [row.cells[0].textContent, cell.cellIndex ? `${column.textContent}: ${cell.textContent}` : ""];
  return [what.filter(Boolean).join(", "), said(cell), said(column), said(row), said(table)].filter(Boolean).join("\n");
}

const tell = (event) => {
  const cell = event.target.closest?.("table.grid th, table.grid td");
  $("origin").textContent = cell && ["focusin", "mouseover"].includes(event.type) ? originOf(cell) : "";
};
for (const type of ["mouseover", "mouseout", "focusin", "focusout"]) document.addEventListener(type, tell);

const inGrid = (cell) => cell.querySelector("button") ?? cell; // in a heading, its button has the focus
for (const table of document.querySelectorAll("table.grid")) {
  table.setAttribute("role", "grid");
  for (const row of table.rows) for (const cell of row.cells) inGrid(cell).tabIndex = -1;
  inGrid(table.rows[0].cells[0]).tabIndex = 0; // Tab enters the grid at the cell that it left last
  table.addEventListener("focusin", (event) => {
    table.querySelector("[tabindex='0']").tabIndex = -1;
    event.target.tabIndex = 0;
  });
  table.addEventListener("keydown", (event) => {
    const { cellIndex: x, parentElement: row } = event.target.closest("th, td");
    const [right, down] = [row.cells.length - 1, table.rows.length - 1], y = row.rowIndex;
    const to = { ArrowLeft: [x - 1, y], ArrowRight: [x + 1, y], ArrowUp: [x, y - 1], ArrowDown: [x, y + 1],
      Home: [0, event.ctrlKey ? 0 : y], End: [right, event.ctrlKey ? down : y] }[event.key];
    if (!to || event.altKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    const cell = table.rows[clamp(to[1], 0, down)].cells[clamp(to[0], 0, right)];
    inGrid(cell).focus();
    cell.scrollIntoView({ block: "nearest", inline: "center" }); // not hidden behind the sticky row heading
  });
}

// ---- speed and accuracy ----

let device = 0; // index into data.devices
const valuesOf = (method) => ({ ...method.values, ...method.times[device] });

const MARKERS = [
  "M-5,0a5,5 0 1,0 10,0a5,5 0 1,0 -10,0Z", "M-4.5,-4.5h9v9h-9Z", "M0,-6L6,0L0,6L-6,0Z", "M0,-6L5.5,4.5H-5.5Z",
  "M0,6L5.5,-4.5H-5.5Z", "M-2,-5.5h4v3.5h3.5v4h-3.5v3.5h-4v-3.5h-3.5v-4h3.5Z", "M-6,0L4.5,-5.5V5.5Z",
];
const families = [...new Set(data.methods.map((method) => method.curve ?? method.id))]; // names of curves, and methods in no curve
const styleOf = (method) => {
  const k = families.indexOf(method.curve ?? method.id);
  return { colour: `var(--c${k % 7})`, marker: MARKERS[k % MARKERS.length], dash: ["none", "6 3", "2 3"][k % 3] };
};
const shortLabel = (method) => (method.curve && /\((.*)\)/.exec(method.label)?.[1]) || method.label;

function tip(event, text) {
  const box = $("tip");
  box.hidden = !text;
  if (!text) return;
  box.textContent = text;
  const at = event.target.getBoundingClientRect();
  box.style.left = `${clamp(at.right + scrollX + 8, 0, document.documentElement.clientWidth - box.offsetWidth - 8)}px`;
  box.style.top = `${at.top + scrollY - box.offsetHeight - 4}px`;
}

function niceTicks(low, high, count) {
  const rough = (high - low) / count || 1;
  const unit = 10 ** Math.floor(Math.log10(rough));
  const step = unit * ([1, 2, 5].find((m) => m * unit >= rough) ?? 10);
  const ticks = [];
  for (let k = Math.ceil(low / step); k * step <= high * (1 + 1e-9); k++) ticks.push(k * step);
  return ticks;
}

function logTicks(low, high) {
  const ticks = [];
  for (let e = Math.floor(Math.log10(low)); e <= Math.log10(high); e++)
    for (const m of [1, 2, 5]) if (m * 10 ** e >= low && m * 10 ** e <= high) ticks.push(m * 10 ** e);
  return ticks.length > 9 ? ticks.filter((t) => /^1/.test(t.toExponential())) : ticks;
}

const plain = (x) => (Math.abs(x) >= 1e5 || (x && Math.abs(x) < 1e-3) ? x.toExponential(0) : String(+x.toPrecision(3)));

function axisTitle(key) {
  const { heading, unit } = data.quantities[key];
  return key === "time_per_frame_s" ? `time per frame (${unit})` : heading;
}

// The Pareto-optimal points, in order of cost.
function paretoFront(points, direction) {
  const sign = direction === "lower" ? 1 : -1;
  const front = [];
  for (const point of [...points].sort((p, q) => p.x - q.x || sign * (p.y - q.y)))
    if (!front.length || sign * point.y < sign * front.at(-1).y) front.push(point);
  return front;
}

function placeLabels(points, width, bounds) {
  const taken = points.map(({ px, py }) => [px - 7, py - 7, px + 7, py + 7]);
  const overlap = ([l, t, r, b], [L, T, R, B]) => Math.max(0, Math.min(r, R) - Math.max(l, L)) * Math.max(0, Math.min(b, B) - Math.max(t, T));
  return points.map((point) => {
    const w = width(point), h = 13;
    const places = [[9, -h / 2], [-9 - w, -h / 2], [-w / 2, -9 - h], [-w / 2, 9], [7, -h - 5], [7, 5], [-7 - w, -h - 5], [-7 - w, 5],
      [-w / 2, -24 - h], [-w / 2, 24], [20, -30], [20, 18]];
    let best = null, least = Infinity;
    places.forEach(([dx, dy], k) => {
      const box = [point.px + dx, point.py + dy, point.px + dx + w, point.py + dy + h];
      const outside = box[0] < bounds[0] || box[2] > bounds[2] || box[1] < bounds[1] || box[3] > bounds[3];
      const cost = taken.reduce((sum, other) => sum + overlap(box, other), 0) + (outside ? 1e4 : 0) + k;
      if (cost < least) [best, least] = [box, cost];
    });
    taken.push(best);
    return best;
  });
}

function drawChart() {
  const [xKey, yKey] = [$("chart-x").value, $("chart-y").value];
  const place = $("chart");
  if (!xKey || !yKey) {
    place.innerHTML = '<p class="note">There are no measurements to draw.</p>';
    return;
  }
  const [xQ, yQ] = [data.quantities[xKey], data.quantities[yKey]];
  const has = (method) => yKey in valuesOf(method) && valuesOf(method)[xKey]?.[0] > 0;
  const points = data.methods.filter(has).map((method) => {
    const [y, low, high, text] = valuesOf(method)[yKey];
    const [s, c] = [yQ.scale, xQ.scale];
    return { method, x: c * valuesOf(method)[xKey][0], y: s * y, low: s * low, high: s * high, text };
  });
  const absent = data.methods.filter((method) => !has(method));
  const W = Math.max(300, place.clientWidth), H = clamp(W * 0.5, 330, 480);
  const [left, right, top, bottom] = [58, W - 14, 26, H - 40];
  const spread = (values, log) => {
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const pad = log ? (high / low) ** 0.08 * 1.08 : (high - low) * 0.09 || Math.abs(high) * 0.1 || 1;
    return log ? [low / pad, high * pad] : [low - pad, high + pad];
  };
  if (!points.length) {
    place.innerHTML = '<p class="note">No method has both quantities.</p>';
    return;
  }
  const onOthers = data.methods.flatMap((method) => method.times.map((times) => times[xKey]?.[0] * xQ.scale));
  const [x0, x1] = spread([...points.map((p) => p.x), ...onOthers.filter((x) => x > 0)], true); // one scale for all devices
  const yLog = yQ.unit === "1" && Math.min(...points.map((p) => p.low)) > 0
    && Math.max(...points.map((p) => p.high)) / Math.min(...points.map((p) => p.low)) > 20;
  const [y0, y1] = spread(points.flatMap((p) => [p.low, p.high]), yLog);
  const toX = (x) => left + (Math.log(x / x0) / Math.log(x1 / x0)) * (right - left);
  const toY = (y) => bottom - (yLog ? Math.log(y / y0) / Math.log(y1 / y0) : (y - y0) / (y1 - y0)) * (bottom - top);
  for (const p of points) [p.px, p.py] = [toX(p.x), toY(p.y)];

  const front = paretoFront(points, yQ.direction);
  const step = front.map((p, k) => (k ? `H${p.px}V${p.py}` : `M${p.px},${p.py}`)).join("") + `H${right}`;
  const narrow = W < 560;
  const label = (p) => shortLabel(p.method);
  const boxes = placeLabels(points, (p) => (narrow && !p.method.curve ? 14 : 6.6 * label(p).length), [left, top, W, bottom]);
  const parts = [];
  for (const x of logTicks(x0, x1)) {
    parts.push(`<line class="grid" x1="${toX(x)}" x2="${toX(x)}" y1="${top}" y2="${bottom}"/>`);
    parts.push(`<text class="axis" x="${toX(x)}" y="${bottom + 16}" text-anchor="middle">${plain(x)}</text>`);
  }
  for (const y of yLog ? logTicks(y0, y1) : niceTicks(y0, y1, 6)) {
    parts.push(`<line class="grid" x1="${left}" x2="${right}" y1="${toY(y)}" y2="${toY(y)}"/>`);
    parts.push(`<text class="axis" x="${left - 6}" y="${toY(y) + 4}" text-anchor="end">${plain(y)}</text>`);
  }
  parts.push(`<text x="${(left + right) / 2}" y="${H - 6}" text-anchor="middle">${escapeText(axisTitle(xKey))}, log</text>`);
  parts.push(`<text x="4" y="14">${escapeText(yQ.heading)}${yLog ? ", log" : ""}</text>`);
  parts.push(`<path d="${step}" fill="none" stroke="var(--front)" stroke-width="6" stroke-linejoin="round"/>`);
  for (const members of Object.values(data.curves)) {
    const on = members.map((id) => points.find((p) => p.method.id === id)).filter(Boolean);
    if (!on.length) continue;
    const { colour, dash } = styleOf(on[0].method);
    parts.push(`<polyline points="${on.map((p) => `${p.px},${p.py}`).join(" ")}" fill="none" stroke="${colour}" stroke-width="1.5" stroke-dasharray="${dash}"/>`);
  }
  points.forEach((p, k) => {
    const { colour, marker } = styleOf(p.method);
    const [l, t, r] = boxes[k];
    const words = `${p.method.label}: ${axisTitle(xKey)} ${plain(p.x)}; ${yQ.heading} ${p.text}`;
    const bars = p.high > p.low ? `<path d="M${p.px},${toY(p.low)}V${toY(p.high)}M${p.px - 4},${toY(p.low)}h8M${p.px - 4},${toY(p.high)}h8" stroke="${colour}" stroke-width="1.3"/>` : "";
    const leader = Math.hypot((l + r) / 2 - p.px, t + 7 - p.py) > 20 + (r - l) / 2 ? `<path d="M${p.px},${p.py}L${(l + r) / 2},${t + 7}" stroke="var(--faint)"/>` : "";
    parts.push(`<g class="point" role="button" tabindex="0" data-method="${escapeText(p.method.id)}" data-tip="${escapeText(words.replace(": ", "\n").replace("; ", "\n"))}" aria-label="${escapeText(words)}; show its images">
      ${leader}${bars}<circle class="ring" cx="${p.px}" cy="${p.py}" r="10" fill="transparent"/>
      <path d="${marker}" transform="translate(${p.px},${p.py})" fill="${colour}" stroke="var(--paper)" stroke-width=".8"/>
      <text class="halo" x="${l}" y="${t + 11}">${escapeText(narrow && !p.method.curve ? families.indexOf(p.method.id) + 1 : label(p))}</text></g>`);
  });
  place.innerHTML = `<svg viewBox="0 0 ${W} ${H}" role="group" aria-label="${escapeText(yQ.heading)} over ${escapeText(axisTitle(xKey))}">${parts.join("")}</svg>`
    + legend(points, narrow);
  const seeds = points.some((p) => p.high > p.low);
  $("chart-note").textContent = (seeds ? "Bars: standard deviation over seeds or, with one seed, the 95% interval over test views. " : "")
    + "Grey: Pareto front. Higher is better for ↑, lower for ↓. Click on a point to show its images."
    + (absent.length ? ` Not shown: ${absent.map((m) => m.label + (m.status === "ok" ? " (not measured)" : ` (${m.status})`)).join(", ")}.` : "");
  $("budget").innerHTML = front.map((p) => `<li>from ${plain(p.x)} ${escapeText(xQ.unit === "1" ? "" : xQ.unit)} up: <button type="button" data-method="${escapeText(p.method.id)}">${escapeText(p.method.label)}</button>, ${escapeText(yQ.heading)} ${escapeText(p.text)}</li>`).join("");
}

function legend(points, narrow) {
  const listed = new Map(points.map((p) => [p.method.curve ?? p.method.id, p.method]));
  return `<div class="key note">${[...listed].filter(([, m]) => narrow || m.curve).map(([name, m]) => {
    const { colour, marker } = styleOf(m);
    const title = m.curve ?? `${families.indexOf(name) + 1} ${m.label}`;
    return `<span><svg viewBox="-8 -8 16 16" style="display:inline;width:14px;height:14px" aria-hidden="true"><path d="${marker}" fill="${colour}"/></svg> ${escapeText(title)}</span>`;
  }).join("")}</div>`;
}

for (const id of ["chart", "budget"]) {
  const show = (event) => {
    const method = event.target.closest("[data-method]")?.dataset.method;
    if (!method || !imageIndex.has(method)) return;
    event.preventDefault();
    set({ a: method });
    $("viewer").scrollIntoView();
    $("stage").focus({ preventScroll: true });
  };
  $(id).addEventListener("click", show);
  if (id === "chart") $(id).addEventListener("keydown", (event) => ["Enter", " "].includes(event.key) && show(event));
}
for (const [enter, leave] of [["mouseover", "mouseout"], ["focusin", "focusout"]]) {
  $("chart").addEventListener(enter, (event) => tip(event, event.target.closest("[data-tip]")?.dataset.tip));
  $("chart").addEventListener(leave, (event) => tip(event, ""));
}
document.addEventListener("keydown", (event) => {
  if (event.key !== "Escape") return;
  tip(event, "");
  $("origin").textContent = "";
});

function drawStages() {
  const time = (method) => valuesOf(method).time_per_frame_s?.[0] ?? 0;
  const most = Math.max(...data.methods.map(time));
  const stages = data.stages.filter((stage) => data.methods.some((method) => valuesOf(method)[`${stage}_s`]));
  const colour = (stage) => `var(--c${stages.indexOf(stage) % 7})`;
  const rows = data.methods.filter(time).map((method) => {
    const segments = stages.filter((stage) => valuesOf(method)[`${stage}_s`]).map((stage) => {
      const [seconds, , , text] = valuesOf(method)[`${stage}_s`];
      return `<i style="width:${(100 * seconds) / time(method)}%;background:${colour(stage)}" title="${stage.replace("_", " ")}: ${text} ms"></i>`;
    });
    return `<span role="listitem"><span>${escapeText(method.label)}</span><span class="row"><span class="segments" style="width:${(72 * time(method)) / most}%">${segments.join("")}</span><span class="total">${(1e3 * time(method)).toFixed(1)} ms</span></span></span>`;
  });
  $("stages").innerHTML = `<span class="key" role="presentation">${stages.map((stage) => `<span><i style="background:${colour(stage)}"></i>${stage.replace("_", " ")}</span>`).join("")}</span>${rows.join("")}`;
}

// ---- packed images: the inverse of nlt/report/packing.py ----

const half = new Float32Array(0x7c00); // value of the half with these bits, times 16
for (let bits = 0; bits < half.length; bits++) {
  const exponent = bits >> 10, mantissa = bits & 0x3ff;
  half[bits] = 16 * (exponent ? (1 + mantissa / 1024) * 2 ** (exponent - 15) : mantissa * 2 ** -24);
}

function unpack(bytes) {
  const { width: W, height: H, dropped, images } = data;
  const size = W * H, count = images.length * 3 * size;
  const codes = new Int16Array(count), values = new Float32Array(count);
  for (let start = 0; start < count; start += size)
    for (let y = 0, i = start; y < H; y++)
      for (let x = 0; x < W; x++, i++) {
        const left = x ? codes[i - 1] : 0, up = y ? codes[i - W] : 0, corner = x && y ? codes[i - W - 1] : 0;
        const guess = clamp(left + up - corner, Math.min(left, up), Math.max(left, up));
        const rest = bytes[i] | (bytes[count + i] << 8);
        codes[i] = guess + ((rest >> 1) ^ -(rest & 1));
      }
  for (let image = 0; image < count; image += 3 * size)
    for (let i = image; i < image + size; i++) {
      codes[i] += codes[i + size];
      codes[i + 2 * size] += codes[i + size];
    }
  for (let i = 0; i < count; i++) values[i] = codes[i] < 0 ? -half[-codes[i] << dropped] : half[codes[i] << dropped];
  return images.map((_, k) => values.subarray(3 * k * size, 3 * (k + 1) * size));
}

const unpacked = new Map(); // view -> promise of its images, for the last few views

function imagesOf(view) {
  const found = unpacked.get(view) ?? (async () => {
    const packed = Uint8Array.from(atob($(`images-${view}`).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return unpack(new Uint8Array(await new Response(stream).arrayBuffer()));
  })();
  unpacked.delete(view);
  unpacked.set(view, found);
  if (unpacked.size > 6) unpacked.delete(unpacked.keys().next().value);
  return found;
}

// ---- display transform, as in nlt/display.py ----

function display(x) {
  const linear = clamp(x, 0, 1);
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
}

const colours = Uint8Array.from(atob(data.colours ?? ""), (c) => c.charCodeAt(0));

// Returns a canvas with an image as displayed, or its error map, at the image's resolution.
function picture(images, index, ev, error) {
  const { width: W, height: H } = data;
  const size = W * H, canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [W, H];
  const pixels = new ImageData(W, H), out = pixels.data, values = images[index], kind = data.images[index].kind;
  const gain = kind === "radiance" ? 2 ** ev : 1, shown = kind === "normal" ? (x) => x : display;
  for (let i = 0; i < size; i++) {
    out[4 * i + 3] = 255;
    if (error && kind === "radiance") {
      let sum = 0;
      for (let c = 0; c < 3; c++) sum += (display(values[i + c * size]) - display(images[0][i + c * size])) ** 2 / 3;
      const entry = 3 * Math.round(255 * Math.min(Math.sqrt(sum) / data.error_scale, 1));
      for (let c = 0; c < 3; c++) out[4 * i + c] = colours[entry + c];
    } else for (let c = 0; c < 3; c++) out[4 * i + c] = 255 * shown(gain * values[i + c * size]);
  }
  canvas.getContext("2d").putImageData(pixels, 0, 0);
  return canvas;
}

// ---- the viewer ----

const imageIndex = new Map(data.images.map((image, k) => [image.id, k]));
const usable = [...imageIndex.keys()];
const firstMethod = data.images.find((image) => methods.has(image.id) && image.id.startsWith("nlt_photons"))
  ?? data.images.findLast((image) => methods.has(image.id)) ?? data.images[1];
const initial = { view: 0, a: firstMethod?.id ?? "reference", b: "reference", mode: "slider", front: "a", split: 0.5,
  zoom: 1, x: 0.5, y: 0.5, ev: 0, error: false, key: "mse" };
const state = { ...initial };
const imageKeys = Object.keys(data.quantities).filter((key) => data.quantities[key].per_image && data.quantities[key].role);
let pictures = { of: "", made: new Map() };
let linkTimer = 0;

function set(change) {
  Object.assign(state, change);
  const edge = 0.5 / state.zoom;
  state.x = clamp(state.x, edge, 1 - edge);
  state.y = clamp(state.y, edge, 1 - edge);
  state.split = clamp(state.split, 0, 1);
  draw();
  clearTimeout(linkTimer);
  linkTimer = setTimeout(() => history.replaceState(null, "", link()), 150); // browsers limit the rate
}

function link() {
  const { view, error, ...rest } = state;
  const round = (v) => (typeof v === "number" ? +v.toFixed(4) : v);
  const all = { view: data.views[view].view, ...rest, error: Number(error) };
  return "#" + new URLSearchParams(Object.entries(all).map(([k, v]) => [k, round(v)]));
}

// Sets the state that a link describes; missing values, or values of another report, keep their defaults.
function restore() {
  const given = new URLSearchParams(location.hash.slice(1));
  if (!data.views.length || !given.has("view")) return;
  const change = { ...initial };
  const view = data.views.findIndex((v) => String(v.view) === given.get("view"));
  if (view >= 0) change.view = view;
  for (const side of ["a", "b"]) if (imageIndex.has(given.get(side))) change[side] = given.get(side);
  for (const [key, values] of Object.entries({ mode: ["slider", "flip"], front: ["a", "b"], key: imageKeys }))
    if (values.includes(given.get(key))) change[key] = given.get(key);
  for (const [key, low, high] of [["split", 0, 1], ["zoom", 1, 64], ["x", 0, 1], ["y", 0, 1], ["ev", -8, 8]])
    if (given.has(key) && !isNaN(parseFloat(given.get(key)))) change[key] = clamp(parseFloat(given.get(key)), low, high);
  change.error = given.get("error") === "1";
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
    if (!pictures.made.has(id)) pictures.made.set(id, picture(images, imageIndex.get(id), ev, error));
    return pictures.made.get(id);
  };
  const [W, H] = [data.width, data.height];
  const source = [(x - 0.5 / zoom) * W, (y - 0.5 / zoom) * H, W / zoom, H / zoom];
  const canvas = $("canvas"), scale = Math.max(1, Math.round($("stage").clientWidth * devicePixelRatio));
  if (canvas.width !== scale) [canvas.width, canvas.height] = [scale, Math.round((scale * H) / W)];
  const context = canvas.getContext("2d");
  const put = (id) => context.drawImage(made(id), ...source, 0, 0, canvas.width, canvas.height);
  context.imageSmoothingEnabled = false;
  put(mode === "flip" && front === "b" ? b : a);
  if (mode === "slider") {
    context.save();
    context.beginPath();
    context.rect(split * canvas.width, 0, canvas.width, canvas.height);
    context.clip();
    put(b);
    context.restore();
  }
  for (const button of $("strip").children) {
    const own = button.firstElementChild, context = own.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.drawImage(made(button.dataset.id), ...source, 0, 0, own.width, own.height);
  }
  canvas.dataset.drawn = JSON.stringify(state); // the tests wait for this
}

const labelOf = (id) => data.images[imageIndex.get(id)].label;
const metricsOf = (id) => data.views[state.view].metrics[id] ?? {};

function drawControls() {
  const { view, a, b, mode, front, split, zoom, ev, error, key } = state;
  for (const [id, value] of Object.entries({ view, a, b, ev, "view-key": key })) $(id).value = value;
  $("ev-value").textContent = `${ev > 0 ? "+" : ""}${ev} EV`;
  $("zoom").textContent = `${+zoom.toPrecision(3)}×`;
  $("error").setAttribute("aria-pressed", error);
  $("flip").setAttribute("aria-pressed", mode === "flip");
  $("slider").setAttribute("aria-pressed", mode === "slider");
  $("link").href = link();
  $("stage").classList.toggle("zoomed", zoom > 1);
  if (mode !== "slider" && document.activeElement === $("divider")) $("stage").focus({ preventScroll: true });
  $("divider").hidden = mode !== "slider";
  $("divider").style.left = `${100 * split}%`;
  $("divider").setAttribute("aria-valuenow", Math.round(100 * split));
  $("corner-a").textContent = `A ${labelOf(a)}`;
  $("corner-b").textContent = `B ${labelOf(b)}`;
  $("corner-a").hidden = mode === "flip" && front === "b";
  $("corner-b").hidden = mode === "flip" && front === "a";
  const seen = mode === "flip" ? labelOf(front === "a" ? a : b) : `${labelOf(a)} left, ${labelOf(b)} right`;
  $("canvas").setAttribute("aria-label", `View ${data.views[view].view}: ${seen}${error ? ", error maps" : ""}`);
  $("stage").setAttribute("aria-label", `Image viewer, view ${data.views[view].view}`);
  $("colour-bar").hidden = !error;
  drawMetrics();
  for (const button of $("strip").children) {
    const { id } = button.dataset;
    button.classList.toggle("is-a", id === a);
    button.classList.toggle("is-b", id === b);
    button.setAttribute("aria-pressed", id === a);
    button.lastElementChild.textContent = metricsOf(id)[key]?.[1] ?? "\u00a0";
  }
}

function drawMetrics() {
  const [a, b] = [metricsOf(state.a), metricsOf(state.b)];
  const rows = imageKeys.filter((key) => a[key] || b[key]).map((key) => {
    const sign = data.quantities[key].direction === "lower" ? 1 : -1;
    const better = a[key] && b[key] ? Math.sign(sign * (b[key][0] - a[key][0])) : 0;
    const cell = (own, wins) => `<td${wins ? ' class="best"' : ""}>${own[key]?.[1] ?? "–"}</td>`;
    return `<tr><th scope="row">${escapeText(data.quantities[key].heading)}</th>${cell(a, better > 0)}${cell(b, better < 0)}</tr>`;
  });
  $("view-metrics").innerHTML = `<thead><tr><th scope="col">this view</th><th scope="col"><b class="tag a">A</b></th><th scope="col"><b class="tag b">B</b></th></tr></thead><tbody>${rows.join("")}</tbody>`;
  drawViews();
}

// Draws a metric of A and B for every view; a click goes to the view.
function drawViews() {
  const { key } = state, W = Math.max(260, $("views").clientWidth), H = 130, [left, top, bottom] = [44, 8, H - 22];
  const value = (k, id) => data.views[k].metrics[id]?.[key]?.[0];
  const all = data.views.flatMap((_, k) => [value(k, state.a), value(k, state.b)]).filter((v) => v !== undefined);
  if (!all.length) {
    $("views").innerHTML = '<p class="note">Neither A nor B has this metric.</p>';
    return;
  }
  const [low, high] = [Math.min(0, ...all), Math.max(...all) || 1];
  const wide = (W - left) / data.views.length;
  const toX = (k) => left + (k + 0.5) * wide, toY = (v) => bottom - ((v - low) / (high - low)) * (bottom - top);
  const parts = niceTicks(low, high, 3).map((v) => `<line class="grid" x1="${left}" x2="${W}" y1="${toY(v)}" y2="${toY(v)}"/><text class="axis" x="${left - 4}" y="${toY(v) + 4}" text-anchor="end">${plain(v)}</text>`);
  data.views.forEach((view, k) => {
    const mark = (id, shape) => (value(k, id) === undefined ? "" : shape(toX(k), toY(value(k, id))));
    parts.push(`<g data-view="${k}" style="cursor:pointer"><title>view ${view.view}</title>
      <rect x="${toX(k) - wide / 2}" y="0" width="${wide}" height="${bottom + 4}" fill="${k === state.view ? "var(--line)" : "transparent"}"/>
      ${mark(state.a, (x, y) => `<circle cx="${x}" cy="${y}" r="3.5" fill="var(--a)"/>`)}
      ${mark(state.b, (x, y) => `<rect x="${x - 3.2}" y="${y - 3.2}" width="6.4" height="6.4" fill="none" stroke="var(--b)" stroke-width="1.8"/>`)}</g>`);
  });
  parts.push(`<text class="axis" x="${left + (W - left) / 2}" y="${H - 4}" text-anchor="middle">view (● A, □ B); click to go there</text>`);
  $("views").innerHTML = `<svg viewBox="0 0 ${W} ${H}" aria-hidden="true">${parts.join("")}</svg>`;
}

function zoomTo(zoom, u = 0.5, v = 0.5) { // keeps the image's point at (u, v) of the stage in place
  const next = clamp(zoom, 1, 64), shift = 1 / state.zoom - 1 / next;
  set({ zoom: next, x: state.x + (u - 0.5) * shift, y: state.y + (v - 0.5) * shift });
}

function pan(dx, dy) {
  set({ x: state.x + dx / state.zoom, y: state.y + dy / state.zoom });
}

const around = (list, now, by) => list[(list.indexOf(now) + by + list.length) % list.length];
const stepView = (by) => set({ view: (state.view + by + data.views.length) % data.views.length });
const flip = () => set(state.mode === "flip" ? { front: state.front === "a" ? "b" : "a" } : { mode: "flip", front: "b" });
const swap = () => set({ a: state.b, b: state.a });
const toggleError = () => set({ error: !state.error });
const expose = (by) => set({ ev: clamp(state.ev + by, -8, 8) });
const reset = () => set({ zoom: 1, x: 0.5, y: 0.5, ev: 0 });
function worst() {
  const sign = data.quantities[state.key].direction === "lower" ? 1 : -1;
  const error = (k) => sign * (data.views[k].metrics[state.a]?.[state.key]?.[0] ?? -sign * Infinity);
  set({ view: data.views.reduce((best, _, k) => (error(k) > error(best) ? k : best), 0) });
}

const KEYS = {
  f: flip, " ": flip, s: () => set({ mode: "slider" }), d: toggleError, r: reset, x: swap, w: worst,
  "+": () => zoomTo(2 * state.zoom), "=": () => zoomTo(2 * state.zoom), "-": () => zoomTo(state.zoom / 2), _: () => zoomTo(state.zoom / 2),
  e: (shift) => expose(shift ? -0.5 : 0.5), b: (shift) => set({ b: around(usable, state.b, shift ? -1 : 1) }),
  ArrowLeft: (shift) => (shift ? pan(-0.1, 0) : stepView(-1)), ArrowRight: (shift) => (shift ? pan(0.1, 0) : stepView(1)),
  ArrowUp: (shift) => (shift ? pan(0, -0.1) : set({ a: around(usable, state.a, -1) })),
  ArrowDown: (shift) => (shift ? pan(0, 0.1) : set({ a: around(usable, state.a, 1) })),
  "?": () => $("keys").showModal(),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const digit = /^Digit([1-9])$/.exec(event.code)?.[1];
  const action = digit && usable[digit - 1] ? (shift) => set({ [shift ? "b" : "a"]: usable[digit - 1] })
    : KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action) return;
  event.preventDefault();
  action(event.shiftKey);
}

function onDividerKey(event) {
  const by = { ArrowLeft: -0.02, ArrowDown: -0.02, ArrowRight: 0.02, ArrowUp: 0.02, PageUp: 0.1, PageDown: -0.1, Home: -1, End: 1 }[event.key];
  if (by === undefined) return;
  event.preventDefault();
  event.stopPropagation();
  set({ split: state.split + by });
}

async function onPoint(event) {
  const box = $("stage").getBoundingClientRect();
  const u = (event.clientX - box.left) / box.width, v = (event.clientY - box.top) / box.height;
  const [W, H] = [data.width, data.height];
  const px = Math.floor((state.x + (u - 0.5) / state.zoom) * W), py = Math.floor((state.y + (v - 0.5) / state.zoom) * H);
  if (px < 0 || py < 0 || px >= W || py >= H) return;
  const { exposure } = data.views[state.view], images = await imagesOf(state.view);
  const value = (id) => {
    const index = imageIndex.get(id), by = data.images[index].kind === "radiance" ? 1 / exposure : 1;
    return [0, 1, 2].map((c) => (by * images[index][c * W * H + py * W + px]).toPrecision(3)).join(" ");
  };
  $("readout").textContent = `pixel ${px}, ${py}   A ${value(state.a)}\nlinear${" ".repeat(`pixel ${px}, ${py}`.length - 6)}   B ${value(state.b)}`;
}

function startDrag(event) {
  if (event.button) return;
  const box = $("stage").getBoundingClientRect();
  const split = event.target === $("divider") || (state.mode === "slider" && state.zoom === 1);
  let { clientX: x, clientY: y } = event;
  const move = (next) => {
    if (split) set({ split: (next.clientX - box.left) / box.width });
    else pan((x - next.clientX) / box.width, (y - next.clientY) / box.height);
    [x, y] = [next.clientX, next.clientY];
  };
  const stage = $("stage");
  stage.setPointerCapture(event.pointerId);
  if (split) move(event);
  stage.addEventListener("pointermove", move);
  for (const end of ["pointerup", "pointercancel"])
    stage.addEventListener(end, () => stage.removeEventListener("pointermove", move), { once: true });
}

function startViewer() {
  $("viewer-body").hidden = false;
  fill($("view"), data.views.map((view, k) => [k, view.view]));
  for (const id of ["a", "b"]) fill($(id), data.images.map((image) => [image.id, image.label]));
  fill($("view-key"), imageKeys.map((key) => [key, data.quantities[key].heading]));
  if (!imageKeys.includes(initial.key)) initial.key = state.key = imageKeys[0];
  $("strip").innerHTML = data.images.map((image, k) => `<button type="button" data-id="${escapeText(image.id)}" title="${escapeText(image.label)}"><canvas width="${Math.max(data.width, 128)}" height="${Math.max(data.height, 128)}" aria-hidden="true"></canvas><span>${k < 9 ? `${k + 1} ` : ""}${escapeText(image.label)}</span><span></span></button>`).join("");
  $("canvas").style.aspectRatio = `${data.width} / ${data.height}`;
  const bar = $("colours").getContext("2d"), strip = bar.createImageData(256, 1);
  for (let i = 0; i < 256; i++) strip.data.set([...colours.subarray(3 * i, 3 * i + 3), 255], 4 * i);
  bar.putImageData(strip, 0, 0);
  $("error-scale").textContent = `≥ ${data.error_scale}`;

  const on = (id, event, action) => $(id).addEventListener(event, action);
  on("view", "change", () => set({ view: Number($("view").value) }));
  for (const side of ["a", "b"]) on(side, "change", () => set({ [side]: $(side).value }));
  on("view-key", "change", () => set({ key: $("view-key").value }));
  on("ev", "input", () => set({ ev: Number($("ev").value) }));
  for (const [id, action] of Object.entries({ previous: () => stepView(-1), next: () => stepView(1), worst, swap, flip, error: toggleError, reset,
    slider: () => set({ mode: "slider" }), "zoom-in": () => zoomTo(2 * state.zoom), "zoom-out": () => zoomTo(state.zoom / 2), help: KEYS["?"] })) on(id, "click", action);
  on("strip", "click", (event) => {
    const id = event.target.closest("button")?.dataset.id;
    if (id) set({ [event.shiftKey ? "b" : "a"]: id });
  });
  on("views", "click", (event) => {
    const view = event.target.closest("[data-view]")?.dataset.view;
    if (view) set({ view: Number(view) });
  });
  on("stage", "keydown", onKey);
  on("divider", "keydown", onDividerKey);
  on("stage", "pointerdown", startDrag);
  on("stage", "pointermove", onPoint);
  on("stage", "wheel", (event) => {
    if (!event.ctrlKey && !$("stage").contains(document.activeElement)) return; // the page scrolls instead
    event.preventDefault();
    const box = $("stage").getBoundingClientRect();
    zoomTo(state.zoom * 2 ** (-Math.sign(event.deltaY) / 2), (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  });
  draw();
}

// ---- start ----

const withRole = (role) => Object.keys(data.quantities).filter((key) => data.quantities[key].role === role);
fill($("chart-y"), withRole("metric").map((key) => [key, data.quantities[key].heading]));
fill($("chart-x"), withRole("cost").map((key) => [key, axisTitle(key)]));
if (data.quantities.mssim) $("chart-y").value = "mssim";
for (const id of ["chart-x", "chart-y"]) $(id).addEventListener("change", drawChart);
fill($("device"), [...data.devices.entries()]);
$("chart-device").hidden = data.devices.length < 2;
$("device").addEventListener("change", () => {
  device = Number($("device").value);
  drawChart();
  drawStages();
});
drawChart();
drawStages();
if (data.views.length) startViewer();
restore();
addEventListener("hashchange", restore);
let width = innerWidth;
addEventListener("resize", () => {
  if (innerWidth === width) return; // a phone's address bar changes only the height
  width = innerWidth;
  drawChart();
  if (data.views.length) draw();
});
