// The side view: picture, bodies, cylinders and points, drawn in pixels.

const canvas = element("canvas");
const view = { x: 0, z: 0, scale: 100 }; // what is at the left and the top [m], pixels per metre
const picture = { image: null, opacity: 0.55, movesPoints: true };
const COLOURS = ["#1f77b4", "#e0701a", "#2b8a57", "#8d62c0", "#b5861b", "#c2456f", "#118a9c", "#7a6a55"];
const BASE_COLOUR = "#7b8794";

const pixels = ([x, z]) => [(x - view.x) * view.scale, (view.z - z) * view.scale];
const position = ([u, v]) => [view.x + u / view.scale, view.z - v / view.scale];
const round = (values) => {
    const step = 10 ** Math.max(-4, Math.floor(Math.log10(0.5 / view.scale)));
    return values.map((value) => Number((Math.round(value / step) * step).toFixed(4)));
};

function draw(tag, attributes, ...children) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
}

// Where a pixel of the picture is [m].
function picturePosition([u, v]) {
    const { width, corner = [0, 0], angle = 0, mirrored } = drawing().picture, { image } = picture;
    const size = width / image.naturalWidth;
    const [a, b] = [(mirrored ? -1 : 1) * size * u, size * (image.naturalHeight - v)];
    return [corner[0] + a * Math.cos(angle) - b * Math.sin(angle), corner[1] + a * Math.sin(angle) + b * Math.cos(angle)];
}

function pictureElement() {
    if (!picture.image) return [];
    const { naturalWidth: width, naturalHeight: height } = picture.image;
    const [[x, y], [a, b], [c, d]] = [[0, 0], [1, 0], [0, 1]].map((place) => pixels(picturePosition(place)));
    const matrix = `matrix(${[a - x, b - y, c - x, d - y, x, y].join(" ")})`;
    picture.element = picture.element || draw("image", { href: picture.image.src, width, height, class: "underlay" });
    picture.element.setAttribute("transform", matrix);
    picture.element.setAttribute("opacity", picture.opacity);
    return [picture.element]; // the same at all times, so that it is decoded once
}

// Places [m] that have to be seen.
function extent() {
    const places = Object.keys(drawing().points).map(place);
    if (picture.image) {
        const { naturalWidth: u, naturalHeight: v } = picture.image;
        places.push(...[[0, 0], [u, 0], [0, v], [u, v]].map(picturePosition));
    }
    return places.length ? places : [[-1, -0.5], [7, 5]];
}

function fit() {
    const { width, height } = canvas.getBoundingClientRect(), places = extent();
    const [low, high] = [Math.min, Math.max].map((f) => [0, 1].map((k) => f(...places.map((one) => one[k]))));
    const margin = picture.image ? 10 : 0.09 * Math.min(width, height), size = [0, 1].map((k) => Math.max(high[k] - low[k], 0.5));
    view.scale = Math.min((width - 2 * margin) / size[0], (height - 2 * margin) / size[1]);
    view.x = (low[0] + high[0]) / 2 - width / 2 / view.scale;
    view.z = (low[1] + high[1]) / 2 + height / 2 / view.scale;
    render();
}

function zoom(factor, [u, v]) {
    const [x, z] = position([u, v]);
    view.scale = Math.min(Math.max(view.scale * factor, 1), 1e5);
    [view.x, view.z] = [x - u / view.scale, z + v / view.scale];
    render();
}

// --- things

const shownPlace = (name) => (moved && moved.points[name]) || place(name);
const isChosen = (section, name) => selection.section === section && selection.name === name;
const isFault = (section, name) => findings.some(({ where, isError }) => isError && where[0] === section && where[1] === name);
const classes = (section, name) => `${section} ${isChosen(section, name) ? "chosen " : ""}${isFault(section, name) ? "fault" : ""}`;

function bodyColour(name) {
    if (name === drawing().base) return BASE_COLOUR;
    const names = Object.keys(drawing().bodies).filter((other) => other !== drawing().base);
    return COLOURS[names.indexOf(name) % COLOURS.length];
}

function outline(points) { return points.map((point) => pixels(point).map((value) => value.toFixed(1)).join(",")).join(" "); }

// Texts take places that are free, the important ones first; where there is none they are left out.
let labels = [];
function label(text, place, kind, far = 8, weight = 1) {
    labels.push({ text, place, kind, far, weight });
    return [];
}

function labelElements() {
    const taken = Object.keys(drawing().points).map((name) => pixels(shownPlace(name))).map(([x, y]) => [x - 4, y - 4, x + 4, y + 4]);
    const found = [], { width, height } = canvas.getBoundingClientRect();
    for (const { text, place: [x, y], kind, far } of labels.sort((one, other) => other.weight - one.weight)) {
        const wide = 7.6 * text.length, spots = far ? [[far, -far], [-wide - far, -far], [far, far + 8], [-wide - far, far + 8], [-wide / 2, -far - 4], [-wide / 2, far + 14]] : [[-wide / 2, 4]];
        const boxes = spots.map(([u, v]) => [x + u, y + v - 10, x + u + wide, y + v + 2]);
        const box = boxes.find(([a, b, c, d]) => a > 0 && b > 0 && c < width && d < height && !taken.some(([e, f, g, h]) => a < g && e < c && b < h && f < d));
        if (!box) continue;
        taken.push(box);
        found.push(draw("text", { x: box[0], y: box[3] - 2, class: kind }, text));
    }
    labels = [];
    return found;
}

function bodyElements(name, body) {
    const places = body.points.filter((point) => drawing().points[point]).map(shownPlace), colour = bodyColour(name);
    if (!places.length) return [];
    const middle = pixels([0, 1].map((k) => places.reduce((sum, one) => sum + one[k], 0) / places.length));
    const mark = { class: classes("bodies", name), "data-section": "bodies", "data-name": name, style: `--colour: ${colour}` };
    const shape = places.length > 2 ? "polygon" : "polyline";
    return [draw("g", mark, draw(shape, { points: outline(places.length > 1 ? places : [places[0], places[0]]) })), ...label(name, middle, "title", places.length > 2 ? 0 : 8, isChosen("bodies", name) ? 3 : 0)];
}

function between([x, y], [u, v], share) { return [x + share * (u - x), y + share * (v - y)]; }

function cylinderElements(section, name, item) {
    if (!item.points.every((point) => drawing().points[point])) return [];
    const ends = item.points.map(shownPlace), [from, to] = ends.map(pixels), length = distance(...ends);
    const shortest = metres(item.shortest), longest = metres(item.longest), isOut = !(length >= shortest - 1e-9 && length <= longest + 1e-9);
    const size = section === "cylinders" ? Math.max(7, (metres(item.bore) || 0) * view.scale) : 6;
    const end = between(from, to, Math.min(0.93, Math.max(0.1, 0.9 * shortest / length || 0.5)));
    const line = (a, b, kind, width) => draw("line", { x1: a[0], y1: a[1], x2: b[0], y2: b[1], class: kind, "stroke-width": width });
    const mark = { class: `${classes(section, name)}${isOut ? " outside" : ""}`, "data-section": section, "data-name": name };
    const text = isChosen(section, name) || isOut ? `${name} ${length.toFixed(3)} m` : name;
    return [draw("g", mark, line(from, to, "rod", size * 0.55), line(from, end, "barrel", size)), ...label(text, between(from, to, 0.5), "title", 6 + size, isChosen(section, name) ? 3 : 0.5)];
}

function pointElements(name) {
    const [x, y] = pixels(shownPlace(name)), owners = bodiesAt(name), isTip = model.tip === name;
    const marks = [draw("circle", { cx: x, cy: y, r: owners.length > 1 ? 5.5 : 4 })];
    if (owners.length > 1) marks.push(draw("circle", { cx: x, cy: y, r: 1.8, class: "hole" }));
    if (isTip) marks.push(draw("path", { d: `M${x - 11} ${y}h22M${x} ${y - 11}v22`, class: "tip" }));
    if (owners.includes(drawing().base)) marks.push(draw("path", { d: `M${x - 10} ${y + 12}h20M${x} ${y}l-6 12M${x} ${y}l6 12m-12 5l4-5m3 5l4-5m3 5l4-5`, class: "ground" }));
    const drives = (drawing().pins[name] || {}).driven;
    if (drives) marks.push(draw("path", { d: `M${x + 9} ${y - 4}a10 10 0 1 0 0 8m0 0l1-6m-1 6l-5-3`, class: "driven" }));
    const chained = chain.points.includes(name) ? " chained" : "";
    return [draw("g", { class: classes("points", name) + chained + (owners.length ? "" : " loose"), "data-section": "points", "data-name": name }, ...marks), ...label(name, [x, y], "letter", 8, isChosen("points", name) ? 4 : 1)];
}

function gridElements() {
    const { width, height } = canvas.getBoundingClientRect(), [left, top] = position([0, 0]), [right, bottom] = position([width, height]);
    const found = [];
    if (!(width && height)) return found;
    for (const [k, low, high, count] of [[0, left, right, width / 90], [1, bottom, top, height / 90]]) {
        const { values, text } = ticks(low, high, count);
        for (const value of values) {
            const [x, y] = pixels(k ? [0, value] : [value, 0]), kind = Math.abs(value) < 1e-9 ? "axis" : "grid";
            found.push(draw("line", k ? { x1: 0, x2: width, y1: y, y2: y, class: kind } : { x1: x, x2: x, y1: 0, y2: height, class: kind }));
            found.push(draw("text", k ? { x: 4, y: y - 3, class: "tick" } : { x: x + 3, y: height - 5, class: "tick" }, text(value)));
        }
    }
    return found;
}

function chainElements() {
    const places = chain.points.map((point) => (Array.isArray(point) ? point : shownPlace(point)));
    if (!places.length) return [];
    const dots = chain.points.filter(Array.isArray).map(pixels).map(([x, y]) => draw("circle", { cx: x, cy: y, r: 4, class: "spot" }));
    return [draw("polyline", { points: outline([...places, ...(chain.pointer ? [chain.pointer] : [])]), class: "chain" }), ...dots];
}

function render() {
    const { points, bodies, cylinders, slides } = drawing();
    const base = Object.entries(bodies).sort(([one], [other]) => (other === drawing().base) - (one === drawing().base));
    canvas.replaceChildren(
        ...pictureElement(), ...gridElements(),
        ...base.flatMap(([name, body]) => bodyElements(name, body)),
        ...Object.entries(cylinders).flatMap(([name, item]) => cylinderElements("cylinders", name, item)),
        ...Object.entries(slides).flatMap(([name, item]) => cylinderElements("slides", name, item)),
        ...chainElements(), ...Object.keys(points).flatMap(pointElements), ...labelElements(),
    );
}
