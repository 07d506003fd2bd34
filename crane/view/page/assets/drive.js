// Levers by keys, pointer and gamepad; the machine in a worker; gauges; the drive as a recording.

const drive = page.drive;
const space = viewer && new Space(page);
const held = new Set(); // keys
const touched = drive.levers.map(() => 0); // levers by pointer
let shown = null, running = false, sent = "";

const worker = new Worker(URL.createObjectURL(new Blob([element("worker-script").textContent], { type: "text/javascript" })));
worker.postMessage({ begin: { ...drive, wasm: bytes(drive.wasm), defaults: doubles(drive.defaults) } });
worker.onmessage = ({ data }) => {
    if (data.rows) save(data.rows);
    else show(data);
};

// --- levers

const KEYS = ["KeyQ", "KeyA", "KeyW", "KeyS", "KeyE", "KeyD", "KeyR", "KeyF", "KeyT", "KeyG", "KeyY", "KeyH"];
const keyName = (code) => code.replace("Key", "");

function fromKeys(i) {
    return (held.has(KEYS[2 * i]) ? 1 : 0) - (held.has(KEYS[2 * i + 1]) ? 1 : 0);
}

// The first levers are the sticks' axes, by the pattern of the page.
function fromGamepad(i) {
    for (const pad of navigator.getGamepads ? navigator.getGamepads() : []) {
        const axis = drive.axes[i];
        if (!pad || axis === undefined || pad.axes.length <= axis.index) continue;
        const value = axis.sign * pad.axes[axis.index];
        if (Math.abs(value) > 0.12) return Math.sign(value) * (Math.abs(value) - 0.12) / 0.88;
    }
    return 0;
}

function wantedLevers() {
    return drive.levers.map((_, i) => Math.max(-1, Math.min(1, fromKeys(i) + fromGamepad(i) + touched[i])));
}

function addLever(lever, i) {
    const slider = make("input", { type: "range", min: -1, max: 1, step: "any", value: 0, title: `${lever.name}: ${keyName(KEYS[2 * i])} and ${keyName(KEYS[2 * i + 1])}` });
    slider.setAttribute("aria-label", lever.name);
    slider.oninput = () => { touched[i] = Number(slider.value); };
    const release = () => { touched[i] = 0; slider.value = 0; };
    for (const event of ["pointerup", "pointercancel", "blur"]) slider.addEventListener(event, release);
    const bar = make("i");
    const row = make("label", { className: "lever" }, make("b", { textContent: lever.name }), slider, make("span", { className: "bar" }, bar));
    element("levers").append(row);
    return { slider, bar };
}
const leverRows = drive.levers.map(addLever);

window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code === "Space") {
        event.preventDefault();
        setRunning(!running);
    } else if (KEYS.slice(0, 2 * drive.levers.length).includes(event.code)) {
        held.add(event.code);
        if (!running && !event.repeat) setRunning(true);
    }
});
window.addEventListener("keyup", (event) => held.delete(event.code));
window.addEventListener("blur", () => held.clear());

// --- what is shown

function addGauge(gauge) {
    const value = make("b"), bar = make("i");
    const row = make("div", { className: "gauge" }, make("span", { textContent: gauge.name }), make("span", { className: "bar" }, bar), value);
    element("gauges").append(row);
    return { ...gauge, value, bar };
}
const gauges = drive.gauges.map(addGauge);

function gaugeValue(gauge, { row, before }) {
    if (gauge.kind === "speed") {
        if (before.length === 0) return 0;
        const from = drive.columns.length;
        return Math.hypot(...[0, 1, 2].map((k) => row[from + k] - before[from + k])) / drive.interval;
    }
    return gauge.terms.reduce((sum, [column, factor]) => sum + factor * row[column], 0);
}

function show(state) {
    shown = state;
    running = state.running;
    element("run").textContent = running ? "pause" : "run";
    document.body.classList.toggle("playing", running);
    element("clock").textContent = `${state.time.toFixed(2)} s`;
    const slow = running && state.factor < 0.9 ? `, ${Math.round(100 * state.factor)} % of real time` : "";
    element("state").textContent = state.status === 1 ? (running ? `running${slow}` : "paused") : drive.statuses[state.status];
    element("state").classList.toggle("fault", state.status !== 1);
    state.levers.forEach((lever, i) => {
        leverRows[i].bar.style.left = `${50 + Math.min(0, 50 * lever)}%`;
        leverRows[i].bar.style.width = `${50 * Math.abs(lever)}%`;
    });
    if (!state.row.length) return;
    for (const gauge of gauges) {
        const exact = gaugeValue(gauge, state);
        const value = Math.abs(exact) < 1e-3 * (gauge.high - gauge.low) ? 0 : exact;
        gauge.value.textContent = `${spoken(value, 3)} ${gauge.unit}`;
        const share = (value - gauge.low) / (gauge.high - gauge.low);
        gauge.bar.style.width = `${100 * Math.max(0, Math.min(1, share))}%`;
    }
}

function draw() {
    const levers = wantedLevers();
    if (levers.join() !== sent) worker.postMessage({ levers });
    sent = levers.join();
    if (shown && space) space.place(space.groups, space.tree.poses(shown.q));
    frames += 1;
    window.requestAnimationFrame(draw);
}
let frames = 0;

function setRunning(on) { worker.postMessage({ running: on }); }

// --- the recording

function save(rows) {
    const names = [...drive.headers, ...(drive.hasTip ? ["tip_x [m]", "tip_y [m]", "tip_z [m]"] : [])];
    const lines = [...drive.notes.map((note) => `# ${note}`), `# crane samples: ${rows.length}`, names.join(",")];
    for (const row of rows) lines.push(Array.from(row, String).join(","));
    const url = URL.createObjectURL(new Blob([lines.join("\n"), "\n"], { type: "text/csv" }));
    make("a", { href: url, download: `${drive.file}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
}

element("run").onclick = () => setRunning(!running);
element("reset").onclick = () => { held.clear(); worker.postMessage({ reset: true }); };
element("save").onclick = () => worker.postMessage({ take: true });
element("machine").textContent = page.machine;
element("task").textContent = page.task;
const keys = drive.levers.map(({ name }, i) => make("tr", {}, make("th", { textContent: name }), make("td", { textContent: `${keyName(KEYS[2 * i])} / ${keyName(KEYS[2 * i + 1])}` })));
element("facts").append(make("table", {}, ...keys));
if (viewer) {
    for (const name of Object.keys(page.views)) {
        element("views").append(make("button", { textContent: name, onclick: () => space.look(name) }));
    }
}
window.requestAnimationFrame(draw);

// For scripts.
window.crane = { get state() { return shown; }, get frames() { return frames; }, held, setRunning, worker };
