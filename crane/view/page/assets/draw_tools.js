// Tools: what clicks and drags on the side view do.

const NEAR = { mouse: 10, pen: 14, touch: 22 }; // of a point [pixels]
const TOOLS = {
    select: { text: "Select", key: "v", hint: "Click a thing to change it, drag points. Drag the ground to pan, wheel or pinch to zoom." },
    point: { text: "Point", key: "p", hint: "Click to set points." },
    body: { text: "Body", key: "b", hint: "Click the pins of one body, in order; a click beside them sets a new point. Enter or done ends it." },
    base: { text: "Base", key: "g", hint: "Click the points that stand on the world." },
    cylinder: { text: "Cylinder", key: "c", hint: "Click the pin of the barrel, then that of the rod." },
    slide: { text: "Slide", key: "s", hint: "Click a point of the outer body, then one of the body that slides in it." },
    tip: { text: "Tip", key: "t", hint: "Click the point that carries the load." },
    move: { text: "Move", key: "m", hint: "Drag a body or a point, or the sliders: the linkage moves, with its loops closed." },
    scale: { text: "scale", isOfPicture: true, hint: "Click two points whose distance is known." },
    axis: { text: "x = 0", isOfPicture: true, hint: "Click a point of the vertical axis from which x counts, as that of slewing or a wheel." },
    ground: { text: "ground", isOfPicture: true, hint: "Click two points of the ground: it becomes level, at z = 0." },
};
const PAIRS = ["cylinder", "slide", "scale", "ground"];

let tool = "select", selection = {}, chain = { points: [], pointer: null, name: null };
const pointers = new Map(); // that are down
let grip = null; // what a pointer holds

function select(section, name) {
    selection = section ? { section, name } : {};
    changedPanel();
    render();
}

function setTool(name, body = null) {
    if (tool === "move" && name !== "move") check();
    tool = name;
    endChain();
    if (body) chain = { points: [...drawing().bodies[body].points], pointer: null, name: body };
    for (const one of document.querySelectorAll("#tools button")) one.setAttribute("aria-pressed", one.id === `tool-${name}`);
    canvas.setAttribute("class", `tool-${name}`);
    tell(TOOLS[name].hint);
    showChain();
    changedPanel();
    render();
}

function endChain() { chain = { points: [], pointer: null, name: null }; showChain(); }

function showChain() { element("chain").hidden = !chain.points.length; element("done").hidden = tool !== "body"; }

function finishBody() {
    const { points, name } = chain;
    if (!points.length) return;
    endChain();
    change(() => {
        const body = name || add("bodies", { points });
        drawing().bodies[body].points = points;
        selection = { section: "bodies", name: body };
    });
}

// --- what is under a pointer

function pointNear([u, v], kind) {
    let [found, least] = [null, NEAR[kind] || NEAR.mouse];
    for (const name of Object.keys(drawing().points)) {
        const away = distance(pixels(shownPlace(name)), [u, v]);
        if (away <= least) [found, least] = [name, away];
    }
    return found;
}

function thingAt(event, where) {
    const point = pointNear(where, event.pointerType);
    if (point !== null) return { section: "points", name: point };
    const mark = event.target.closest("[data-section]");
    return mark ? { section: mark.dataset.section, name: mark.dataset.name } : null;
}

// --- clicks

function clickPlace(thing, where) { // the point there, which is set where there is none
    if (thing && thing.section === "points") return thing.name;
    return add("points", round(position(where)));
}

function toggle(name, point) {
    const { points } = drawing().bodies[name];
    drawing().bodies[name].points = points.includes(point) ? points.filter((one) => one !== point) : [...points, point];
}

const CLICKS = {
    select: (thing) => (thing ? select(thing.section, thing.name) : select()),
    point: (thing, where) => change(() => { selection = { section: "points", name: clickPlace(thing, where) }; }),
    body(thing, where) {
        const { points: [first, ...others] } = chain; // the first or the last point, once more, ends it
        if (thing && thing.section === "points" && others.length && [first, others[others.length - 1]].includes(thing.name)) {
            finishBody();
            return;
        }
        change(() => {
            const point = clickPlace(thing, where), { points } = chain;
            chain.points = points.includes(point) ? points.filter((one) => one !== point) : [...points, point];
        });
    },
    base: (thing, where) => change(() => {
        const { bodies } = drawing();
        if (!bodies[drawing().base]) add("bodies", { points: [] }, drawing().base);
        toggle(drawing().base, clickPlace(thing, where));
    }),
    tip: (thing, where) => change(() => {
        const point = clickPlace(thing, where);
        model.tip = model.tip === point ? "" : point;
        selection = { section: "points", name: point };
    }),
    axis: (_, where) => {
        change(() => transform({ shift: [-position(where)[0], 0] }, picture.movesPoints));
        setTool("select");
        fit();
    },
    move: () => {},
};

// Two clicks: of points, or of places on the picture.
function clickPair(thing, where) {
    const isOfPicture = TOOLS[tool].isOfPicture;
    change(() => {
        let one = isOfPicture ? (thing && thing.section === "points" ? place(thing.name) : position(where)) : clickPlace(thing, where);
        if (!isOfPicture && thing && thing.section === "bodies") drawing().bodies[thing.name].points.push(one);
        chain.points.push(one);
        if (chain.points.length < 2) return;
        const [first, second] = chain.points;
        one = tool;
        endChain();
        if (first !== second) FINISHED[one](first, second);
    });
}

function lengths(points) {
    const drawn = distance(...points.map(place)), digits = drawn > 1 ? 2 : 3;
    return { shortest: Number((0.8 * drawn).toFixed(digits)), longest: Number((1.25 * drawn).toFixed(digits)) };
}

const FINISHED = {
    cylinder(...points) {
        const others = Object.values(drawing().cylinders), { bore = 0.1, rod = 0.06 } = others[others.length - 1] || {};
        selection = { section: "cylinders", name: add("cylinders", { points, bore, rod, ...lengths(points) }) };
    },
    slide(...points) {
        const bodies = points.map((point) => bodiesAt(point)[0]);
        if (bodies.includes(undefined) || bodies[0] === bodies[1]) tell("a slide is between a point of one body and a point of another", true);
        else selection = { section: "slides", name: add("slides", { bodies, points, ...lengths(points), driven: true }) };
    },
    scale(first, second) {
        question("distance of these points [m]", (text) => {
            const length = metres(text), drawn = distance(first, second);
            if (!(length > 0)) return "a length is a number above 0, as 2.9 or 2900 mm";
            change(() => transform({ scale: length / drawn }, picture.movesPoints));
            setTool("select");
            fit();
            return "";
        });
    },
    ground(first, second) {
        const [left, right] = first[0] < second[0] ? [first, second] : [second, first];
        const turn = -Math.atan2(right[1] - left[1], right[0] - left[0]);
        transform({ turn, shift: [0, -(left[0] * Math.sin(turn) + left[1] * Math.cos(turn))] }, picture.movesPoints);
        window.setTimeout(() => { setTool("select"); fit(); });
    },
};

function question(text, answer) {
    const ask = element("ask"), box = element("answer");
    ask.hidden = false;
    ask.querySelector("label").textContent = text;
    box.value = "";
    box.focus();
    ask.onsubmit = (event) => {
        event.preventDefault();
        const problem = answer(box.value);
        if (problem) tell(problem, true);
        else ask.hidden = true;
    };
    element("refuse").onclick = () => { ask.hidden = true; };
}

// --- pointers

const at = (event) => {
    const { left, top } = canvas.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
};

function grasp(thing, where) {
    if (tool === "move") {
        const { section, name } = thing || {};
        const points = !thing || !moved ? [] : section === "points" ? [name] : drawing()[section][name].points;
        const away = (point) => distance(pixels(shownPlace(point)), where);
        const held = points.filter((point) => moved.points[point]).sort((one, other) => away(one) - away(other))[0];
        if (!held) return { pans: true };
        const [x, z] = position(where), [u, v] = shownPlace(held);
        return { drags: held, offset: [u - x, v - z] };
    }
    if (thing && thing.section === "points" && !TOOLS[tool].isOfPicture) return { point: thing.name, before: state() };
    return { pans: true };
}

canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    const where = at(event);
    if (document.activeElement && document.activeElement.dataset.field) document.activeElement.blur();
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, where);
    const thing = thingAt(event, where);
    grip = pointers.size > 1 ? { pinches: true, hasMoved: true } : { ...grasp(thing, where), thing, start: where, hasMoved: false };
});

canvas.addEventListener("pointermove", (event) => {
    const where = at(event), before = pointers.get(event.pointerId), shown = round(position(where));
    element("place").textContent = `${shown[0].toFixed(3)}, ${shown[1].toFixed(3)} m`;
    if (!before) {
        chain.pointer = chain.points.length ? position(where) : null;
        if (chain.pointer) render();
        return;
    }
    pointers.set(event.pointerId, where);
    if (grip.pinches) {
        const other = [...pointers].find(([id]) => id !== event.pointerId);
        if (!other) return;
        zoom(distance(where, other[1]) / Math.max(distance(before, other[1]), 1), between(where, other[1], 0.5));
        return;
    }
    if (!grip.hasMoved && distance(where, grip.start) < (event.pointerType === "mouse" ? 3 : 8)) return;
    grip.hasMoved = true;
    if (grip.pans) {
        view.x -= (where[0] - before[0]) / view.scale;
        view.z += (where[1] - before[1]) / view.scale;
    } else if (grip.point) {
        selection = { section: "points", name: grip.point };
        setPlace(grip.point, shown);
        changedSoon();
    } else {
        const [x, z] = position(where);
        ask("drag", { point: grip.drags, x: x + grip.offset[0], z: z + grip.offset[1] });
    }
    render();
});

function release(event) {
    if (!pointers.delete(event.pointerId) || !grip) return;
    const held = grip;
    if (!pointers.size) grip = null;
    if (held.point && held.hasMoved) noteChange(held.before);
    if (held.hasMoved || event.type === "pointercancel") return;
    (PAIRS.includes(tool) ? clickPair : CLICKS[tool])(held.thing, held.start);
    showChain();
    render();
}
canvas.addEventListener("pointerup", release);
canvas.addEventListener("pointercancel", release);
canvas.addEventListener("dblclick", () => tool === "body" && finishBody());
canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), at(event));
}, { passive: false });

// --- keys

function nudge(event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!way || selection.section !== "points") return false;
    const step = event.shiftKey ? 0.01 : 0.001, [x, z] = place(selection.name);
    change(() => setPlace(selection.name, [x + step * way[0], z + step * way[1]].map((value) => Number(value.toFixed(4)))));
    return true;
}

function control(key, isShifted) {
    if (key === "s") save();
    else if (key === "z" && !isShifted) travel(history.done, history.undone);
    else if (key === "y" || key === "z") travel(history.undone, history.done);
    else return false;
    return true;
}

window.addEventListener("keydown", (event) => {
    const isTyping = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.target.type !== "checkbox" && event.target.type !== "range";
    const key = event.key.toLowerCase();
    if ((event.ctrlKey || event.metaKey) && (!isTyping || key === "s")) {
        if (isTyping) event.target.blur();
        if (control(key, event.shiftKey)) event.preventDefault();
        return;
    }
    if (isTyping) {
        if (key === "escape") event.target.blur();
        return;
    }
    const wanted = Object.keys(TOOLS).find((name) => TOOLS[name].key === key);
    if (key === "escape") {
        if (chain.points.length) endChain();
        else setTool("select");
    } else if (key === "enter" && tool === "body") finishBody();
    else if ((key === "delete" || key === "backspace") && selection.section) {
        const { section, name } = selection;
        select();
        change(() => remove(section, name));
    } else if (key === "f") fit();
    else if (wanted && !event.altKey) setTool(wanted);
    else if (!nudge(event)) return;
    event.preventDefault();
    render();
});
