// The machine at its own steps: levers in, states out. One row per step is kept for the recording.

let given, machine, numbers, instance, tip, levers, wanted, rows, status;
let running = false, due = 0, last = 0, computed = 0, busy = 0;

const START = 64; // of the instance in the memory, in numbers

async function begin(message) {
    given = message;
    const { instance: made } = await WebAssembly.instantiate(given.wasm, { math: Math });
    machine = made.exports;
    numbers = new Float64Array(machine.memory.buffer);
    instance = numbers.subarray(START, START + given.defaults.length);
    tip = START + given.defaults.length;
    reset();
    setTimeout(lap);
}

function reset() {
    instance.set(given.defaults);
    levers = given.levers.map(() => 0);
    wanted = given.levers.map(() => 0);
    rows = [];
    [due, computed, busy, running] = [0, 0, 0, false];
    instance[given.step] = given.interval;
    status = machine.initialize(8 * START);
    if (status === 1) keep();
    tell();
}

// Where the tip is: position, Jacobian and bias follow each other.
function findTip() {
    if (!given.hasTip) return [];
    machine.tip(8 * START, 8 * (START + given.q), 8 * (START + given.v), 8 * tip);
    return numbers.subarray(tip, tip + 3);
}

function keep() {
    machine.update_outputs(8 * START);
    rows.push(Float64Array.from([...given.columns.map((index) => instance[index]), ...findTip()]));
}

// Signals of levers from -1 to 1; they jump over the dead band, as the electronics do.
function signal({ neutral, full, overlap }, lever) {
    return neutral + (full - neutral) * (lever * (1 - overlap) + overlap * Math.sign(lever));
}

function advance() {
    const most = given.interval / given.ramp;
    given.levers.forEach((lever, i) => {
        const way = wanted[i] - levers[i];
        levers[i] += Math.max(-most, Math.min(most, way));
        instance[lever.index] = signal(lever, levers[i]);
    });
    status = machine.advance(8 * START);
    if (status === 1) keep();
    else running = false;
}

// Real time where the processor holds it, else slower, never larger steps.
function lap() {
    const now = performance.now();
    if (running) {
        const passed = Math.min((now - last) / 1000, 0.25);
        due = Math.min(due + passed, 0.25);
        const before = rows.length;
        while (running && due >= given.interval && performance.now() - now < 40) {
            advance();
            due -= given.interval;
        }
        computed = 0.95 * computed + given.interval * (rows.length - before);
        busy = 0.95 * busy + passed;
        if (rows.length > before || !running) tell();
    }
    last = now;
    setTimeout(lap, 4);
}

function tell() {
    postMessage({
        status, running, levers, time: instance[0], factor: busy ? computed / busy : 1,
        q: Array.from(instance.subarray(given.q, given.q + given.nq)),
        row: rows.length ? Array.from(rows[rows.length - 1]) : [],
        before: rows.length > 1 ? Array.from(rows[rows.length - 2]) : [],
    });
}

onmessage = ({ data }) => {
    if (data.begin) begin(data.begin);
    if (data.levers) wanted = data.levers;
    if (data.reset) reset();
    if (data.running !== undefined) {
        running = data.running && status === 1;
        [last, due] = [performance.now(), 0];
        tell();
    }
    if (data.take) postMessage({ rows });
};
