// Gauges: dials, positions and pressures of joints, payload and slope, goals.

const ARC = 270, LENGTH = 2 * Math.PI * 40 * ARC / 360; // of a dial [degrees], of a radius of 40

function svg(tag, attributes, ...children) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
}

function addDial(dial) {
    const turn = { cx: 50, cy: 50, r: 40, fill: "none", transform: "rotate(135 50 50)" };
    const value = make("b"), arc = svg("circle", { ...turn, class: "value" });
    const back = svg("circle", { ...turn, class: "back", "stroke-dasharray": `${LENGTH} 999` });
    const face = svg("svg", { viewBox: "4 4 92 84" }, back, arc);
    element("dials").append(make("div", { className: "dial", title: dial.name }, make("div", {}, face, value, make("small", { textContent: dial.unit })), make("span", { textContent: dial.name })));
    return { ...dial, value, arc };
}

function dialValue(dial, state) {
    const { row, before } = state;
    if (dial.read) return dial.read(state);
    const from = drive.columns.length;
    if (dial.kind === "speed") return before.length ? Math.hypot(...[0, 1, 2].map((k) => row[from + k] - before[from + k])) / drive.interval : 0;
    if (dial.kind === "stability") return 100 * row[from + (drive.hasTip ? 4 : 1)];
    if (dial.kind === "flow") return before.length && drive.energy.oil !== null ? 6e4 * (row[drive.energy.oil] - before[drive.energy.oil]) / drive.interval : 0;
    return dial.terms.reduce((sum, [column, factor]) => sum + factor * row[column], 0);
}

const share = (value, { low, high }) => Math.max(0, Math.min(1, (value - low) / (high - low)));

function steady(value, { low, high }) { return Math.abs(value) < 1e-3 * (high - low) ? 0 : value; }

function showDial(dial, state) {
    const value = steady(dialValue(dial, state), dial);
    dial.value.textContent = spoken(value, 3);
    dial.arc.setAttribute("stroke-dasharray", `${LENGTH * share(value, dial)} 999`);
    dial.arc.classList.toggle("warns", dial.kind === "stability" && value < 20);
}

// A row: name and a small text below, bars, value and a small text below.
function addRow(name, title, barTitles) {
    const bars = barTitles.map(() => make("i")), value = make("b"), texts = [make("small"), make("small")];
    const column = make("span", { className: "bars" }, ...bars.map((bar, k) => make("span", { className: "bar", title: barTitles[k] }, bar)));
    element("gauges").append(make("div", { className: "gauge", title }, make("span", { textContent: name }), column, value, ...texts));
    return { bars, value, texts };
}

function addJoint(joint) {
    const sides = joint.pressures.map((_, k) => `pressure in ${"AB"[k]}`);
    return { ...joint, ...addRow(joint.name, joint.name, ["position", ...sides]) };
}

function showJoint(joint, { row }) {
    const position = joint.scale * row[joint.column], [left, right] = joint.texts;
    joint.value.textContent = `${spoken(steady(position, joint), 3)} ${joint.unit}`;
    joint.bars[0].style.width = `${100 * share(position, joint)}%`;
    if (!joint.pressures.length) {
        right.textContent = joint.force === null ? "free" : `${spoken(row[joint.force], 3)} ${joint.forceUnit}`;
        return;
    }
    joint.pressures.forEach((column, k) => { joint.bars[1 + k].style.width = `${100 * Math.min(1, row[column] / joint.highest)}%`; });
    const flow = 6e4 * row[joint.flow];
    left.textContent = `${spoken(Math.abs(flow) < 0.05 ? 0 : flow, 2)} l/min`;
    right.textContent = `${joint.pressures.map((column) => Math.round(row[column] / 1e5)).join(" | ")} bar`;
}

function addLoad(load) {
    return { ...load, ...addRow(load.name, `force of the ground at ${load.name}`, ["force"]), axes: [0, 1, 2].map((k) => load.column + k), highest: 1 };
}

function showLoad(load, { row }) {
    const force = Math.hypot(...load.axes.map((k) => row[k]));
    load.highest = Math.max(load.highest, force);
    load.bars[0].style.width = `${100 * force / load.highest}%`;
    load.value.textContent = `${spoken(force < 1 ? 0 : force / 1e3, 3)} kN`;
}

// --- payload and slope

function addSlider(name, unit, options, change) {
    const value = make("b"), slider = make("input", { type: "range", step: 1, ...options });
    slider.setAttribute("aria-label", name);
    slider.oninput = () => change(Number(slider.value));
    element("conditions").append(make("label", { className: "condition" }, make("span", { textContent: name }), slider, value));
    return (position, text) => {
        if (document.activeElement !== slider || Number(slider.value) === position) slider.value = position;
        value.textContent = `${text} ${unit}`;
    };
}

class Conditions {
    constructor() {
        const { payload, gravity } = drive;
        const send = (conditions) => worker.postMessage({ conditions });
        if (payload) this.payload = addSlider("payload", "kg", { min: 0, max: payload.masses.length - 1 }, (k) => send({ payload: k }));
        if (gravity) {
            this.pitch = addSlider("slope along x", "°", { min: -15, max: 15 }, (pitch) => send({ pitch }));
            this.roll = addSlider("slope along y", "°", { min: -15, max: 15 }, (roll) => send({ roll }));
        }
        if (!drive.holdsWeight) return;
        this.box = make("input", { type: "checkbox" });
        this.box.onchange = () => worker.postMessage({ holds: this.box.checked });
        element("conditions").append(make("label", { className: "condition box" }, this.box, "drives carry the weight and brake"));
    }

    show({ holds, conditions: { payload, pitch, roll } }) {
        if (this.box) this.box.checked = holds;
        if (this.payload) this.payload(payload, spoken(drive.payload.masses[payload], 4));
        if (!this.pitch) return;
        this.pitch(pitch, String(pitch).replace("-", "\u2212"));
        this.roll(roll, String(roll).replace("-", "\u2212"));
    }
}

// --- goals

const duration = (time) => `${time.toFixed(1)} s`;
const energyText = (x) => (x > 1e6 ? `${spoken(x / 1e6, 3)} MJ` : x > 1e3 ? `${spoken(x / 1e3, 3)} kJ` : `${spoken(x, 3)} J`);
const RESULT_TEXTS = {
    time: duration, energy: energyText, fuel: (x) => `${spoken(1e3 * x, 3)} g`, smoothness: (x) => spoken(x, 3),
    "lever travel": (x) => spoken(x, 3), deviation: (x) => `${spoken(1e3 * x, 3)} mm`, "smallest tipping margin": (x) => `${spoken(100 * x, 3)} %`,
};

function resultTable(result) {
    return make("table", {}, ...Object.entries(result).filter(([name]) => RESULT_TEXTS[name]).map(([name, x]) => make("tr", {}, make("th", { textContent: name }), make("td", { textContent: RESULT_TEXTS[name](x) }))));
}

class Goals {
    constructor() {
        const select = element("goal");
        select.append(make("option", { value: "", textContent: "drive freely" }), ...drive.goals.map(({ name }, i) => make("option", { value: i, textContent: name })));
        select.hidden = !drive.goals.length;
        select.onchange = () => {
            worker.postMessage({ goal: select.value === "" ? null : Number(select.value) });
            select.blur();
        };
        this.told = "";
    }

    show({ goal, time, results }) {
        const card = element("told"), chosen = drive.goals[goal.index];
        card.hidden = !chosen;
        if (!chosen) return;
        if (goal.isDone) {
            if (this.told !== results) card.replaceChildren(make("b", { textContent: `${chosen.name}: done` }), resultTable(results[results.length - 1]), again(goal.index));
            this.told = results;
            return;
        }
        this.told = "";
        const clock = goal.start === null ? "the clock runs from the first lever" : duration(time - goal.start);
        const point = `point ${goal.next + 1} of ${chosen.points.length}`;
        const wish = { [chosen.take]: "take the load: stay", [chosen.put]: "put the load down: stay" }[goal.next] || point;
        card.replaceChildren(make("b", { textContent: chosen.text }), make("span", { textContent: `${wish} · ${clock}` }));
    }
}

function again(index) {
    const button = make("button", { textContent: "once more" });
    button.onclick = () => worker.postMessage({ goal: index });
    return button;
}
