// The page: levers to the machine in its worker, its states to gauges and space.

const drive = page.drive;
let shown = null, sent = "", frames = 0;

const worker = new Worker(URL.createObjectURL(new Blob([element("worker-script").textContent], { type: "text/javascript" })));

function setRunning(on) { worker.postMessage({ running: on }); }

const levers = new Levers(drive.levers);
const space = viewer && new DriveSpace(page);
const dials = drive.dials.map(addDial);
const joints = drive.joints.map(addJoint);
const loads = drive.loads.map(addLoad);
const handGauges = new HandGauges();
const conditions = new Conditions();
const goals = new Goals();
const pull = space && drive.pull && new Pull();
listenToKeys(levers);

worker.postMessage({
    begin: {
        ...drive, wasm: bytes(drive.wasm), defaults: doubles(drive.defaults),
        payload: drive.payload && { ...drive.payload, values: doubles(drive.payload.values) },
    },
});
worker.onmessage = ({ data }) => {
    if (!data.rows) shown = data;
    else if (data.purpose === "file") save(data);
};

function stateText({ status, running, factor, time }) {
    if (status !== 1) return drive.statuses[status];
    if (running && factor < 0.93) return `running at ${Math.round(100 * factor)} % of real time`;
    return running ? "running" : time ? "paused" : "move a lever to begin";
}

function show(state) {
    element("run").textContent = state.running ? "pause" : "run";
    document.body.classList.toggle("playing", state.running);
    element("clock").textContent = `${state.time.toFixed(2)} s`;
    element("state").textContent = stateText(state);
    element("state").classList.toggle("fault", state.status !== 1);
    element("save").disabled = !state.hasMoved;
    element("repeat").textContent = state.hasMoved ? command(state.changed) : "";
    conditions.show(state);
    goals.show(state);
    if (!state.row.length) return;
    for (const dial of dials) showDial(dial, state);
    handGauges.show(state);
    if (pull) pull.show(state);
    for (const joint of joints) showJoint(joint, state);
    for (const load of loads) showLoad(load, state);
}

const READABLE = 50; // interval of the numbers, which nobody reads at every frame [ms]
let drawn = null, written = null, writtenAt = 0;
function draw(now) {
    const wanted = levers.wanted();
    if (wanted.join() !== sent) {
        worker.postMessage({ levers: wanted });
        if (wanted.some((x) => x) && shown && !shown.running && shown.status === 1) setRunning(true);
    }
    sent = wanted.join();
    if (shown && shown !== drawn) {
        levers.show(shown.levers);
        if (space && shown.row.length) space.show(shown);
    }
    if (shown && shown !== written && (now - writtenAt > READABLE || !shown.running)) {
        show(shown);
        [written, writtenAt] = [shown, now];
    }
    drawn = shown;
    if (space) space.draw(now);
    frames += 1;
    window.requestAnimationFrame(draw);
}

element("run").onclick = () => setRunning(!(shown && shown.running));
element("reset").onclick = () => {
    levers.held.clear();
    worker.postMessage({ reset: true });
};
element("save").onclick = () => worker.postMessage({ take: "file" });
element("machine").textContent = page.machine;

// --- what is chosen and told in the card

const patterns = Object.keys(PATTERNS).map((name) => make("option", { value: name, textContent: name, selected: name === levers.pattern }));
const pattern = make("select", { id: "pattern" }, ...patterns);
pattern.onchange = () => {
    levers.choose(pattern.value);
    pattern.blur();
};
element("facts").append(
    make("label", {}, "pattern ", pattern),
    make("p", { textContent: "Keys W A S D and I J K L or arrows, with shift for fine motion; or drag the sticks; or a gamepad." }),
    ...(drive.levers.some((lever) => lever.assumed) ? [make("p", { textContent: "Drives without effort in the file: full forces are assumed." })] : []),
);
if (viewer) {
    for (const name of Object.keys(page.views)) {
        element("views").append(make("button", { textContent: name, onclick: () => space.look(name) }));
    }
}
window.requestAnimationFrame(draw);

// For scripts, and further parts of the page: inputs of the instance by name.
window.crane = {
    get state() { return shown; }, get frames() { return frames; }, levers, setRunning, worker,
    setInputs(inputs) { worker.postMessage({ inputs }); },
    take() {
        return new Promise((resolve) => {
            worker.addEventListener("message", ({ data }) => { if (data.rows) resolve(recordingText(data)); });
            worker.postMessage({ take: "text" });
        });
    },
};
