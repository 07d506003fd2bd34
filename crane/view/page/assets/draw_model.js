// The drawing: as the section of a machine file, with its history and its names.

const SECTIONS = ["points", "bodies", "pins", "cylinders", "slides"];
const ITEM = { points: "point", bodies: "body", cylinders: "cylinder", slides: "slide" };

const model = { name: "machine", tip: "", ...page.model };
const drawing = () => model.drawing;
model.drawing = { base: "frame", points: {}, bodies: {}, ...model.drawing };
for (const section of SECTIONS) model.drawing[section] = model.drawing[section] || {};
if (!Object.keys(model.drawing.bodies).length) model.drawing.bodies[model.drawing.base] = { points: [] };
const isBegun = () => Object.keys(drawing().bodies).length > 1;

let renames = {}; // by section: names in the file, by new names
const history = { undone: [], done: [], saved: "" };
const isKnown = {}; // by section the names that the file has

// What is sent and written: nothing that is empty.
function content() {
    const { tip, ...whole } = model, sections = { ...drawing() };
    for (const [name, pin] of Object.entries(sections.pins)) if (!Object.keys(pin).length) delete sections.pins[name];
    for (const section of ["pins", "cylinders", "slides"]) if (!Object.keys(sections[section]).length) delete sections[section];
    return { ...whole, ...(tip ? { tip } : {}), drawing: sections };
}

function noteSaved() {
    for (const section of SECTIONS) isKnown[section] = new Set(Object.keys(drawing()[section]));
    renames = {};
    history.saved = JSON.stringify(content());
}

const state = () => JSON.stringify({ model, renames });

function restore(text) {
    const found = JSON.parse(text);
    Object.assign(model, found.model);
    renames = found.renames;
}

// Change the drawing, as one step of its history.
function change(action) {
    const before = state();
    action();
    noteChange(before);
}

function noteChange(before) {
    if (state() === before) return;
    history.done.push(before);
    history.undone.length = 0;
    changed();
}

function travel(from, to) {
    if (!from.length) return;
    to.push(state());
    restore(from.pop());
    changed();
}

// --- names

function forget(section, name) { // a name of the file that stands for something else now
    for (const [to, from] of Object.entries(renames[section] || {})) if (from === name) delete renames[section][to];
}

function freeName(section) {
    const taken = drawing()[section];
    const letter = (i) => (i < 26 ? "" : letter(Math.floor(i / 26) - 1)) + String.fromCharCode(65 + i % 26);
    const prefix = { bodies: "body", cylinders: "X", slides: "slide" }[section];
    for (let i = 0; ; i++) {
        const name = prefix ? `${prefix}${i + 1}` : letter(i);
        if (!(name in taken) && !(name in drawing().bodies)) return name;
    }
}

function add(section, item, name = freeName(section)) {
    forget(section, name);
    drawing()[section][name] = item;
    return name;
}

const renamed = (items, from, to) => Object.fromEntries(Object.entries(items).map(([name, item]) => [name === from ? to : name, item]));

// Rename, with all that refers to it; returns what is wrong, if anything.
function rename(section, from, to) {
    if (!to || Number.isFinite(Number(to))) return "a name is neither empty nor a number";
    if (to in drawing()[section]) return `there is a ${ITEM[section]} '${to}' already`;
    for (const part of section === "points" ? ["points", "pins"] : [section]) {
        const names = renames[part] = renames[part] || {};
        const before = names[from] || (isKnown[part].has(from) ? from : undefined);
        forget(part, to);
        delete names[from];
        if (before && before !== to) names[to] = before;
        drawing()[part] = renamed(drawing()[part], from, to);
    }
    const other = (name) => (name === from ? to : name);
    const lists = section === "points" ? pointLists() : section === "bodies" ? Object.values(drawing().slides).map((slide) => [slide, "bodies"]) : [];
    for (const [item, key] of lists) item[key] = item[key].map(other);
    if (section === "points") {
        model.tip = other(model.tip);
        for (const body of Object.values(drawing().bodies)) if (body.centre === from) body.centre = to;
    }
    if (section === "bodies") drawing().base = other(drawing().base);
    if (model.tip === from && section === "bodies") model.tip = to;
    return "";
}

// All lists of points: items with the keys that hold them.
function* pointLists() {
    const { bodies, cylinders, slides } = drawing();
    for (const item of [...Object.values(bodies), ...Object.values(cylinders), ...Object.values(slides)]) yield [item, "points"];
    for (const body of Object.values(bodies)) {
        for (const plate of body.plates || []) yield [plate, "outline"];
        for (const tube of body.tubes || []) yield [tube, "points"];
    }
}

function remove(section, name) {
    delete drawing()[section][name];
    if (section === "bodies") {
        for (const [slide, item] of Object.entries(drawing().slides)) if (item.bodies.includes(name)) remove("slides", slide);
        return;
    }
    if (section !== "points") return;
    for (const [item, key] of pointLists()) item[key] = item[key].filter((point) => point !== name);
    for (const part of ["cylinders", "slides"]) {
        for (const [other, item] of Object.entries(drawing()[part])) if (item.points.length < 2) delete drawing()[part][other];
    }
    delete drawing().pins[name];
    if (model.tip === name) model.tip = "";
}

// --- geometry, in metres: x forward, z up

const place = (name) => {
    const point = drawing().points[name];
    return point && [point[0], point[point.length - 1]];
};
const bodiesAt = (point) => Object.keys(drawing().bodies).filter((name) => drawing().bodies[name].points.includes(point));
const distance = ([a, b], [c, d]) => Math.hypot(c - a, d - b);

function setPlace(name, [x, z]) {
    const point = drawing().points[name];
    drawing().points[name] = point && point.length === 3 ? [x, point[1], z] : [x, z];
}

const LENGTHS = { "": 1, m: 1, cm: 0.01, mm: 0.001, in: 0.0254, ft: 0.3048 };

// A length in metres of a number or a text such as "120 mm"; NaN if it is none.
function metres(value) {
    const [, number, unit] = String(value).trim().match(/^([-+\d.eE]+?)\s*([a-z]*)$/) || [];
    return number && unit in LENGTHS ? Number(number) * LENGTHS[unit] : NaN;
}

// Move picture, points and centres of mass: first scaled, then turned, then shifted.
function transform({ scale = 1, turn = 0, shift = [0, 0] }, withPoints) {
    const [c, s] = [scale * Math.cos(turn), scale * Math.sin(turn)];
    const moved = ([x, z]) => [c * x - s * z + shift[0], s * x + c * z + shift[1]].map((value) => Number(value.toFixed(4)));
    const { picture } = drawing();
    picture.corner = moved(picture.corner || [0, 0]);
    picture.width = Number((picture.width * scale).toPrecision(6));
    if (turn) picture.angle = Number(((picture.angle || 0) + turn).toFixed(6));
    if (!withPoints) return;
    for (const name of Object.keys(drawing().points)) setPlace(name, moved(place(name)));
    for (const body of Object.values(drawing().bodies)) {
        if (!Array.isArray(body.centre)) continue;
        const [x, z] = moved([Number(body.centre[0]), Number(body.centre[body.centre.length - 1])]);
        body.centre = body.centre.length === 3 ? [x, body.centre[1], z] : [x, z];
    }
}

// Left becomes right.
function mirror(withPoints) {
    const { picture } = drawing();
    picture.corner = [-picture.corner[0], picture.corner[1]];
    if (picture.angle) picture.angle = -picture.angle;
    picture.mirrored = !picture.mirrored;
    if (!picture.mirrored) delete picture.mirrored;
    if (!withPoints) return;
    for (const name of Object.keys(drawing().points)) setPlace(name, [-place(name)[0] || 0, place(name)[1]]);
    for (const body of Object.values(drawing().bodies)) if (Array.isArray(body.centre)) body.centre[0] *= -1;
}
