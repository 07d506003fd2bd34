"use strict";
// A chart of rated loads: cells in the colour of what ends their load, contours, and the machine
// in the posture of the cell under the cursor.
const data = JSON.parse(document.getElementById("data").textContent);
const [RADIUS, HEIGHT, LOAD, CAUSE, EACH, STROKES, PRESSURES, SHAPE, ANGLE] = [0, 1, 2, 3, 4, 5, 6, 7, 8];
const byId = (id) => document.getElementById(id);
const chart = byId("chart");
const EDGE = { left: 46, right: 10, top: 10, bottom: 38 };  // pixels around the chart
let slew = 0, here = null, scale = 1, origin = [0, 0];

// Elements, whose text is never read as HTML.
function make(kind, attributes = {}, ...inside) {
  const svg = ["g", "rect", "path", "text", "line", "circle"].includes(kind);
  const one = svg ? document.createElementNS("http://www.w3.org/2000/svg", kind)
                  : document.createElement(kind);
  for (const [name, value] of Object.entries(attributes)) one.setAttribute(name, value);
  one.append(...inside);
  return one;
}

// Metres to pixels.
const px = (x) => origin[0] + scale * x;
const py = (y) => origin[1] - scale * y;
const points = (row) => {
  const out = [];
  for (let i = 0; i < row.length; i += 2)
    out.push(`${px(row[i] * data.unit).toFixed(1)} ${py(row[i + 1] * data.unit).toFixed(1)}`);
  return out;
};
const way = (row, closed) => row.length ? `M${points(row).join("L")}${closed ? "Z" : ""}` : "";

function number(value, digits = 4) {
  if (value === null) return "\u2013";
  const text = Math.abs(value) >= 10 ** digits ? value.toFixed(0) : String(+value.toPrecision(digits));
  return text.replace("-", "\u2212");
}

// Loads are rounded down.
function kg(value) {
  if (!value) return value === null ? "no end" : "0";
  const ten = 10 ** Math.max(3 - Math.floor(Math.log10(value)), 0);
  return String(+(Math.floor(value * ten * (1 + 1e-7)) / ten).toPrecision(12));
}

function tint(cause) { return cause < 0 ? "#eeeeee" : data.tints[cause] ?? "#dddddd"; }

// Round distances between the numbers of an axis.
function ticks(low, high, room) {
  const rough = (high - low) / Math.max(room / 60, 2), power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find((x) => x * power >= rough), out = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) out.push(+(i * step).toPrecision(6));
  return out;
}

function draw() {
  chart.style.height = "";  // as large as the page lets it be, and no higher than is drawn
  const box = chart.getBoundingClientRect(), [low, high] = [data.low, data.high];
  const room = [box.width - EDGE.left - EDGE.right, box.height - EDGE.top - EDGE.bottom];
  scale = Math.min(room[0] / (high[0] - low[0]), room[1] / (high[1] - low[1]));
  const size = [scale * (high[0] - low[0]), scale * (high[1] - low[1])];
  chart.style.height = `${EDGE.top + size[1] + EDGE.bottom}px`;
  const left = EDGE.left + (room[0] - size[0]) / 2, base = EDGE.top + size[1];
  origin = [left - scale * low[0], base + scale * low[1]];
  chart.replaceChildren(cells(), axes(left, base, size), lines(), make("g", { id: "cursor" }));
  show();
}

function cells() {
  const group = make("g"), [w, h] = data.step.map((x) => Math.max(scale * x, 6));
  for (const cell of data.cells[slew]) {
    group.append(make("rect", {
      x: px(cell[RADIUS]) - w / 2, y: py(cell[HEIGHT]) - h / 2, width: w + 0.4, height: h + 0.4,
      fill: tint(cell[CAUSE]),
    }));
  }
  return group;
}

function axes(left, base, size) {
  const group = make("g"), ink = { stroke: "#333", "stroke-width": 1 };
  const [low, high] = [data.low, data.high], right = left + size[0];
  group.append(make("path", { d: `M${left} ${base - size[1]}V${base}H${right}`, fill: "none", ...ink }));
  if (low[1] < 0 && high[1] > 0 && data.names[1] === "height")
    group.append(make("line", { x1: left, x2: right, y1: py(0), y2: py(0), ...ink }));
  for (const x of ticks(low[0], high[0], size[0]))
    group.append(make("line", { x1: px(x), x2: px(x), y1: base, y2: base + 4, ...ink }),
      make("text", { x: px(x), y: base + 16, "text-anchor": "middle" }, number(x)));
  for (const y of ticks(low[1], high[1], size[1]))
    group.append(make("line", { x1: left - 4, x2: left, y1: py(y), y2: py(y), ...ink }),
      make("text", { x: left - 7, y: py(y) + 4, "text-anchor": "end" }, number(y)));
  const middle = base - size[1] / 2;
  group.append(
    make("text", { x: left + size[0] / 2, y: base + 32, "text-anchor": "middle" }, `${data.names[0]} [m]`),
    make("text", { x: left - 34, y: middle, "text-anchor": "middle",
      transform: `rotate(-90 ${left - 34} ${middle})` }, `${data.names[1]} [m]`));
  return group;
}

function lines() {
  const group = make("g"), taken = [];
  for (const [words, rows] of data.contours[slew]) {
    for (const row of rows)
      group.append(make("path", { d: way(row), fill: "none", stroke: "#333", "stroke-width": 0.9 }));
    const longest = rows.reduce((a, b) => (b.length > a.length ? b : a)), half = longest.length >> 2;
    for (const i of [half, half >> 1, half + (half >> 1)]) {  // where no other label is
      const [x, y] = [px(longest[2 * i] * data.unit), py(longest[2 * i + 1] * data.unit)];
      if (taken.some(([a, b]) => Math.abs(a - x) < 44 && Math.abs(b - y) < 15)) continue;
      taken.push([x, y]);
      group.append(make("text", { x, y, class: "level" }, words));
      break;
    }
  }
  return group;
}

function machine(cell) {
  const group = make("g"), [bodies, cylinders] = data.shapes[cell[SHAPE]];
  group.append(make("path", { d: way(data.standing[slew], true), fill: "#8b929b", stroke: "#8b929b",
    "stroke-width": 4 }));
  for (const body of bodies)
    group.append(make("path", { d: way(body, true), fill: body.length > 4 ? "#4a4f5744" : "none",
      stroke: "#4a4f57", "stroke-width": 1.6, "stroke-linejoin": "round" }));
  for (const row of cylinders)
    group.append(
      make("path", { d: way([row[0], row[1], row[4], row[5]]), stroke: "#6d747d", "stroke-width": 1.5 }),
      make("path", { d: way(row.slice(0, 4)), stroke: "#4a4f57", "stroke-width": 4 }));
  group.append(make("circle", { cx: px(cell[RADIUS]), cy: py(cell[HEIGHT]), r: 6, fill: "none",
    stroke: "#b3261e", "stroke-width": 2 }));
  return group;
}

function row(kind, ...cells) {
  return make("tr", {}, ...cells.map((inside, i) =>
    make(kind, i ? { class: "n" } : {}, ...(Array.isArray(inside) ? inside : [inside]))));
}

function show() {
  byId("cursor").replaceChildren(machine(here));
  const load = here[LOAD] === null ? kg(null) : `${kg(here[LOAD])} kg`;
  const angle = here.length > ANGLE ? `, angle ${number(+here[ANGLE].toFixed(1))}\u00b0` : "";
  const place = `at ${number(here[RADIUS])} m, ${data.names[1]} ${number(here[HEIGHT])} m${angle}`;
  byId("load").replaceChildren(load, " ", make("small", {}, place));
  byId("why").textContent = data.causes[here[CAUSE]] ?? "";
  const order = here[EACH].map((x, k) => [x, k]).filter(([x]) => x !== null).sort((a, b) => a[0] - b[0]);
  byId("causes").replaceChildren(make("table", {}, row("th", "limiting factor", "kg"), ...order.map(([x, k]) =>
    row("td", [make("i", { style: `background:${tint(k)}` }), data.causes[k]], kg(x)))));
  const pressed = here[PRESSURES].some((x) => x.length);
  const head = ["drive", "stroke", ...(pressed ? ["A [bar]", "B [bar]", "limit"] : [])];
  byId("drives").replaceChildren(make("table", {}, row("th", ...head), ...data.drives.map((one, i) =>
    row("td", one.joint, `${number(here[STROKES][i], 5)} ${one.unit}`,
      ...(pressed ? pressures(here[PRESSURES][i], one.limits) : [])))));
}

function pressures(values, limits) {
  if (!values.length) return ["", "", ""];
  const most = [...new Set(limits.map((x) => number(x)))].join(", ");
  return [...values.map((x) => number(x, 3)), most];
}

// The cell nearest to a place.
function nearest(x, y) {
  const apart = (cell) => (cell[RADIUS] - x) ** 2 + (cell[HEIGHT] - y) ** 2;
  return data.cells[slew].reduce((a, b) => (apart(b) < apart(a) ? b : a));
}

function go(x, y) {
  here = nearest(x, y);
  show();
}

function point(event) {
  if (event.pointerType !== "mouse" && event.type === "pointermove" && !event.buttons) return;
  const box = chart.getBoundingClientRect();
  go((event.clientX - box.left - origin[0]) / scale, (origin[1] - event.clientY + box.top) / scale);
}

function turn(k) {
  slew = k;
  [...byId("slews").children].forEach((one, i) => one.setAttribute("aria-pressed", String(i === k)));
  const [x, y] = here ?? [data.low[0] + 0.72 * (data.high[0] - data.low[0]), 0.25 * data.high[1]];
  here = nearest(x, y);
  draw();
}

for (const kind of ["pointermove", "pointerdown"]) chart.addEventListener(kind, point);
chart.addEventListener("keydown", (event) => {
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  if (!(event.key in ways)) return;
  event.preventDefault();
  go(here[RADIUS] + ways[event.key][0] * data.step[0], here[HEIGHT] + ways[event.key][1] * data.step[1]);
});
if (data.slews.length > 1) {
  data.slews.forEach((name, k) => {
    const button = make("button", { type: "button" }, name);
    button.addEventListener("click", () => turn(k));
    byId("slews").append(button);
  });
}
for (const k of Object.keys(data.tints))
  byId("legend").append(make("li", {}, make("i", { style: `background:${tint(k)}` }), data.causes[k]));
for (const [name, text] of data.facts) byId("facts").append(make("dt", {}, name), make("dd", {}, text));
turn(0);
new ResizeObserver(draw).observe(chart);
