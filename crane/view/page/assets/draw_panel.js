// The panel: findings, what is selected, what there is, the picture.

const UNITS = { m: 1000, rad: 180 / Math.PI }, SHOWN = { m: "mm", rad: "°" }; // of sliders

const card = (title, ...parts) => make("section", { className: "card" }, ...(title ? [make("h2", {}, ...[title].flat())] : []), ...parts);
const chips = (text, ...parts) => make("div", { className: "chips" }, make("span", { textContent: text }), make("div", { className: "buttons" }, ...parts));
const button = (text, onclick, properties = {}) => make("button", { textContent: text, onclick, ...properties });

// A text as the value that it means: a number, a list of them, or itself.
function meaning(text) {
    const parts = text.split(/[,;]\s*|\s+(?=[-\d])/).map((part) => part.trim()).filter(Boolean);
    const numbers = parts.map((part) => (/^[-+.\d]/.test(part) && Number.isFinite(Number(part)) ? Number(part) : part));
    if (!parts.length) return undefined;
    if (parts.length > 1 && numbers.every((part) => typeof part === "number")) return numbers;
    return parts.length === 1 ? numbers[0] : text.trim();
}

const kilograms = (mass) => `${Number(mass.toPrecision(4))} kg`;
const written = (value) => (value === undefined || value === null ? "" : Array.isArray(value) ? value.join(", ") : String(value));

function set(item, key, value) {
    if (value === undefined || value === "" || value === false) delete item[key];
    else item[key] = value;
}

function input(field, value, onchange, properties = {}) {
    const made = make("input", { value: written(value), autocomplete: "off", spellcheck: false, ...properties });
    Object.assign(made.dataset, { field, shown: made.value });
    made.onchange = () => {
        made.dataset.shown = made.value;
        onchange(made.value);
    };
    made.onkeydown = ({ key }) => { if (key === "Enter") made.blur(); }; // keys are those of tools again
    return made;
}

// A row of a form for a key of the machine file.
function fieldRow(item, { key, text, unit, kind, choices, empty }, id) {
    const title = empty ? `${text}; by default ${empty}` : text, name = key.replace("_", " ");
    if (kind === "flag") {
        const box = make("input", { type: "checkbox", checked: item[key] === true || item[key] === "yes" });
        box.dataset.field = id;
        box.onchange = () => change(() => set(item, key, box.checked));
        return make("label", { className: "field box", title }, box, name);
    }
    if (kind === "choice") {
        const select = make("select", {}, ...choices.map((choice) => make("option", { value: choice, textContent: choice, selected: choice === (item[key] || empty) })));
        select.dataset.field = id;
        select.onchange = () => change(() => set(item, key, select.value === empty ? undefined : select.value));
        return make("label", { className: "field", title }, make("span", { textContent: name }), select, make("i"));
    }
    const read = kind === "names" ? (value) => value.split(/[,\s]+/).filter(Boolean) : meaning;
    const box = input(id, item[key], (value) => change(() => set(item, key, read(value))), { placeholder: empty.length < 14 ? empty : "", inputMode: kind === "number" ? "decimal" : "text" });
    return make("label", { className: "field", title }, make("span", { textContent: name }), box, make("i", { textContent: unit }));
}

// A key of the JSON Schema as a field.
function field(key, { description, type, items, anyOf, $ref, ...schema }) {
    const [, text, unit = ""] = description.match(/^(.*?)(?: \[(.*)\])?$/), choices = schema.enum || [];
    const kind = choices.includes(true) ? "flag" : choices.length ? "choice" : items && items.type === "string" ? "names" : $ref ? "number" : "value";
    return { key, text, unit, kind, choices, empty: written(schema.default) };
}

const form = (item, section, id, hidden) => Object.entries(page.forms[section]).filter(([key]) => !hidden.includes(key)).map(([key, schema]) => fieldRow(item, field(key, schema), `${id}.${key}`));

function nameRow(section, name) {
    return make("label", { className: "field" }, make("span", { textContent: "name" }), input(`${section}.name`, name, (value) => {
        const to = value.trim();
        if (to === name) return;
        const before = state(), problem = rename(section, name, to);
        if (problem) tell(problem, true);
        else {
            select(section, to);
            tell(TOOLS[tool].hint);
        }
        noteChange(before);
        changedPanel();
    }), make("i"));
}

function ownFindings(section, name) {
    const own = findings.filter(({ where }) => where[0] === section && where[1] === name);
    return own.map(({ text, isError }) => make("p", { className: isError ? "finding error" : "finding", textContent: text }));
}

const deleteButton = (section, name) => button("delete", () => {
    select();
    change(() => remove(section, name));
}, { className: "delete", title: "delete (Del)" });

function pointCard(name) {
    const bodies = bodiesAt(name), point = drawing().points[name];
    const coordinate = (text, k) => make("label", { className: "field" }, make("span", { textContent: text }), input(`points.${text}`, point[k], (value) => {
        if (Number.isFinite(metres(value))) change(() => { point[k] = metres(value); });
        else tell(`'${value}' is no length, give one as 1.25 or 1250 mm`, true);
        changedPanel();
    }, { inputMode: "decimal" }), make("i", { textContent: "m" }));
    const across = point.length === 3 ? [coordinate("y", 1)] : [];
    const owners = Object.keys(drawing().bodies).map((body) => {
        const { points } = drawing().bodies[body], isOn = points.includes(name);
        const chip = button(body, () => change(() => { drawing().bodies[body].points = isOn ? points.filter((x) => x !== name) : [...points, name]; }), { className: "chip" });
        chip.setAttribute("aria-pressed", isOn);
        return chip;
    });
    const tip = make("input", { type: "checkbox", checked: model.tip === name });
    tip.onchange = () => change(() => { model.tip = tip.checked ? name : ""; });
    const pin = drawing().pins[name] = drawing().pins[name] || {};
    const parts = [
        ...ownFindings("points", name), nameRow("points", name), coordinate("x", 0), ...across, coordinate("z", point.length - 1),
        chips("on", ...owners),
        make("label", { className: "field box", title: "what carries the load" }, tip, "tip of the machine"),
    ];
    if (bodies.length > 1) parts.push(make("h3", { textContent: "pin" }), ...ownFindings("pins", name), ...form(pin, "pins", "pins", []));
    return card([bodies.length > 1 ? "Pin " : "Point ", make("b", { textContent: name })], ...parts, deleteButton("points", name));
}

function partCards(body, name) {
    const kinds = [["plates", { outline: [...body.points], thickness: 0.02 }], ["tubes", { points: body.points.slice(0, 2), height: 0.2, wall: 0.01 }]];
    const least = { plates: 3, tubes: 2 }, word = { plates: "plate", tubes: "tube" };
    const parts = kinds.flatMap(([kind]) => (body[kind] || []).map((part, i) => make("div", { className: "part" }, make("h3", { textContent: word[kind] }), button("×", () => change(() => {
        body[kind].splice(i, 1);
        if (!body[kind].length) delete body[kind];
    }), { className: "close", title: `remove this ${word[kind]}` }), ...form(part, kind, `bodies.${kind}.${i}`, []))));
    const adds = kinds.map(([kind, part]) => button(`+ ${word[kind]}`, () => change(() => { body[kind] = [...(body[kind] || []), part]; }), { disabled: body.points.length < least[kind], title: `mass, centre and inertia from a ${word[kind]}` }));
    return [...parts, make("div", { className: "buttons" }, ...adds)];
}

function bodyCard(name) {
    const body = drawing().bodies[name], isBase = drawing().base === name, mass = masses[name];
    const base = make("input", { type: "checkbox", checked: isBase });
    base.onchange = () => change(() => { if (base.checked) drawing().base = name; });
    const pins = body.points.map((point) => button(point, () => select("points", point), { className: "chip" }));
    const told = mass && body.mass === undefined ? [make("p", { className: "note", textContent: `${kilograms(mass)} ${body.plates || body.tubes ? "from its shape" : "estimated from its cylinders"}` })] : [];
    return card(["Body ", make("b", { textContent: name })], ...ownFindings("bodies", name), nameRow("bodies", name),
        chips("pins", ...pins, button("change", () => setTool("body", name), { className: "chip", title: "click its pins again" })),
        make("label", { className: "field box" }, base, "stands on the world"),
        ...form(body, "bodies", "bodies", ["points", "plates", "tubes"]), ...told, ...partCards(body, name), deleteButton("bodies", name));
}

function cylinderCard(section, name) {
    const item = drawing()[section][name], [from, to] = item.points;
    const swap = button("⇄", () => change(() => { item.points.reverse(); if (item.bodies) item.bodies.reverse(); }), { title: "exchange barrel and rod", className: "chip" });
    const ends = [from, to].map((point) => button(point, () => select("points", point), { className: "chip" }));
    const length = place(from) && place(to) ? distance(place(from), place(to)) : NaN;
    return card([section === "slides" ? "Slide " : "Cylinder ", make("b", { textContent: name })], ...ownFindings(section, name), nameRow(section, name),
        chips(section === "slides" ? "from, to" : "barrel, rod", ends[0], swap, ends[1], make("span", { className: "drawn", textContent: `${length.toFixed(3)} m drawn` })),
        ...form(item, section, section, ["points"]), deleteButton(section, name));
}

// --- motion

let sliders = {};

function moveCard() {
    sliders = {};
    if (!moved) return card("Move", make("p", { className: "note", textContent: "The drawing is no machine yet: correct what is red." }));
    const rows = moved.joints.map(({ name, unit, lower, upper }) => {
        const scale = UNITS[unit] || 1, slider = make("input", { type: "range", min: scale * lower, max: scale * upper, step: "any" });
        slider.setAttribute("aria-label", name);
        slider.oninput = () => ask("move", { joint: name, value: Number(slider.value) / scale });
        const value = make("output"), force = make("output", { className: "note" });
        sliders[name] = { slider, value, force };
        return make("div", { className: "motion" }, make("b", { textContent: name }), value, slider, force);
    });
    const told = make("p", { className: "finding", id: "refusal", hidden: true });
    const found = card("Move", ...rows, told, make("p", { className: "note", textContent: "Forces hold the weight at rest." }), make("div", { className: "buttons" }, button("as drawn", () => check())));
    window.setTimeout(showMotion);
    return found;
}

function showMotion() {
    for (const { name, unit, value, force, forceUnit } of moved ? moved.joints : []) {
        if (!sliders[name]) return;
        const shown = (UNITS[unit] || 1) * value, { slider } = sliders[name];
        if (document.activeElement !== slider || Math.abs(slider.value - shown) > 1e-3 * (slider.max - slider.min)) slider.value = shown;
        sliders[name].value.textContent = `${shown.toFixed(unit === "m" ? 0 : 1)} ${SHOWN[unit] || unit}`;
        sliders[name].force.textContent = `${spoken(force / 1000, 3)} k${forceUnit}`;
    }
    const told = element("refusal");
    if (told) [told.hidden, told.textContent] = [!moved.refusal, moved.refusal];
}

// --- what there is

function row(section, name, text) {
    const found = button("", () => select(section, name), { className: `item ${isFault(section, name) ? "fault" : ""}` });
    found.setAttribute("aria-pressed", isChosen(section, name));
    const dot = make("span", { className: "dot" });
    if (section === "bodies") dot.style.background = bodyColour(name);
    found.append(...(section === "bodies" ? [dot] : []), make("b", { textContent: name }), ...text.map((part) => make("span", { textContent: part })));
    return found;
}

function lists() {
    const { bodies, cylinders, slides, points } = drawing();
    const mass = (name) => (masses[name] ? `${kilograms(masses[name])}` : "");
    const range = ({ points: [from, to], shortest, longest }) => [`${from} to ${to}`, `${written(shortest)} … ${written(longest)}`];
    const parts = [
        ["Bodies", Object.keys(bodies).map((name) => row("bodies", name, [bodies[name].points.join(" "), name === drawing().base ? "base" : mass(name)]))],
        ["Cylinders", Object.entries(cylinders).map(([name, item]) => row("cylinders", name, range(item)))],
        ["Slides", Object.entries(slides).map(([name, item]) => row("slides", name, range(item)))],
        ["Points", [make("div", { className: "buttons" }, ...Object.keys(points).map((name) => button(name, () => select("points", name), { className: `chip ${isFault("points", name) ? "fault" : ""}` })))]],
    ];
    return parts.filter(([title, rows]) => rows.length && (title !== "Points" || Object.keys(points).length)).map(([title, rows]) => card(title, ...rows));
}

function pictureCard() {
    if (!page.hasPicture) return [];
    const opacity = make("input", { type: "range", min: 0, max: 1, step: 0.05, value: picture.opacity });
    opacity.setAttribute("aria-label", "opacity of the picture");
    opacity.oninput = () => { picture.opacity = Number(opacity.value); render(); };
    const moves = make("input", { type: "checkbox", checked: picture.movesPoints });
    moves.onchange = () => { picture.movesPoints = moves.checked; };
    const tools = Object.entries(TOOLS).filter(([, tool]) => tool.isOfPicture).map(([name, tool]) => button(tool.text, () => setTool(name), { title: tool.hint }));
    for (const [i, name] of ["scale", "axis", "ground"].entries()) tools[i].setAttribute("aria-pressed", tool === name);
    return [card("Picture", make("div", { className: "buttons" }, ...tools, button("mirror", () => { change(() => mirror(picture.movesPoints)); fit(); }, { title: "exchange left and right: x points forward" })),
        make("label", { className: "field" }, make("span", { textContent: "opacity" }), opacity, make("i")),
        make("label", { className: "field box", title: "or only the picture moves under them" }, moves, "points stay on the picture"))];
}

function findingCard(isOfErrors) {
    const other = findings.filter(({ where, isError }) => isError === isOfErrors && !isChosen(...where));
    const rows = isBegun() ? other.map(({ where, text }) => button("", () => where.length && select(where[0] === "pins" ? "points" : where[0], where[1]), { className: `finding ${isOfErrors ? "error" : ""}`, textContent: text })) : [];
    return rows.length ? [card("", ...rows)] : [];
}

const welcome = () => card("A machine by its pins", ...[
    ...(page.hasPicture ? ["Picture: scale it by two points whose distance is printed; then x = 0, and the ground."] : ["Start crane draw with --picture FILE to draw on a side view."]),
    "Body: click its pins, in order, then done. A point of two bodies is a pin.",
    "Base: click the pins that stand on the world.",
    "Cylinder: click the pin of the barrel, then that of the rod.",
    "Move: drag, and the linkage moves.",
].map((text) => make("p", { className: "note", textContent: text })));

function selectionCard() {
    const { section, name } = selection;
    if (tool === "move") return [moveCard()];
    if (section && drawing()[section][name]) return [section === "points" ? pointCard(name) : section === "bodies" ? bodyCard(name) : cylinderCard(section, name)];
    return Object.keys(drawing().points).length ? [] : [welcome()];
}

let shownThing = "";
function renderPanel() {
    const { value, dataset: { field, shown } } = document.activeElement;
    if (shown !== undefined && value !== shown) { // somebody writes: the panel waits
        document.activeElement.addEventListener("blur", changedPanel, { once: true });
        return;
    }
    const side = element("side"), thing = JSON.stringify([selection, tool === "move"]);
    const top = thing === shownThing ? side.scrollTop : 0;
    shownThing = thing;
    side.replaceChildren(...findingCard(true), ...selectionCard(), ...findingCard(false), ...pictureCard(), ...lists());
    side.scrollTop = top;
    const again = field && side.querySelector(`[data-field="${CSS.escape(field)}"]`);
    if (again) again.focus();
    if (again && again.select) again.select();
}
