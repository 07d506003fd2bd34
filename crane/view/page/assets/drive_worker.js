// The machine at its own steps: levers in, states out. One row per step is kept for the recording.

let given, machine, numbers, instance, scratch, levers, wanted, inputs, status, stability, goals;
let running = false, due = 0, last = 0, computed = 0, busy = 0, spent = 0, holds = false;
let rows, record, conditions, base, hand;

const START = 64; // of the instance in the memory, in numbers
const HERE = 8 * START;

async function begin(message) {
    given = message;
    const { instance: made } = await WebAssembly.instantiate(given.wasm, { math: Math });
    machine = made.exports;
    numbers = new Float64Array(machine.memory.buffer);
    instance = numbers.subarray(START, START + given.defaults.length);
    scratch = START + given.defaults.length;
    conditions = { payload: given.payload ? given.payload.start : 0, pitch: 0, roll: 0 };
    base = conditions;
    stability = given.stability && new Stability(given);
    goals = new GoalRun(given);
    hand = new Hand(given, START + given.handMemory);
    holds = given.holdsWeight && given.levers.every(({ braking }) => braking > 0);
    reset();
    setTimeout(lap);
}

function part(name) {
    const [first, size] = given.parts[name];
    return instance.subarray(first, first + size);
}

function reset() {
    conditions = base;
    instance.set(given.defaults);
    levers = given.levers.map(() => 0);
    [wanted, inputs] = [given.levers.map(() => 0), {}];
    rows = [];
    [due, computed, busy, spent, running] = [0, 0, 0, 0, false];
    applyConditions();
    record = { changed: changes(base), changes: [], results: [] };
    part("step")[0] = given.interval;
    status = machine.initialize(HERE);
    goals.begin();
    hand.begin();
    if (status === 1) keep();
    tell();
}

// --- payload and slope: elements of the instance, and parameters of the library

function gravityAt({ pitch, roll }) {
    const direction = [Math.tan(pitch * Math.PI / 180), Math.tan(roll * Math.PI / 180), -1];
    return direction.map((x) => given.gravity.value * x / Math.hypot(...direction));
}

function applyConditions() {
    const [first, size] = given.parts.dynamics;
    instance.set(given.defaults.subarray(first, first + size), first); // no joint sticks or slips
    if (given.payload) {
        const { indices, values } = given.payload;
        indices.forEach((index, i) => { instance[index] = values[indices.length * conditions.payload + i]; });
    }
    if (given.gravity) instance.set(gravityAt(conditions), given.gravity.index);
    if (stability) stability.load(conditions.payload);
}

// What differs from the machine as it was written to the page, as parameters.
function changes({ payload, pitch, roll }, before = { payload: given.payload && given.payload.start, pitch: 0, roll: 0 }) {
    const found = {};
    if (given.payload && payload !== before.payload) found["payload.mass"] = given.payload.masses[payload];
    if (pitch !== before.pitch || roll !== before.roll) {
        gravityAt({ pitch, roll }).forEach((x, i) => { found[`gravity.${"xyz"[i]}`] = x; });
    }
    return found;
}

// Between two steps; before the first one the drive begins with them.
function setConditions(next) {
    const changed = changes(next, conditions);
    if (!Object.keys(changed).length) return;
    if (rows.length < 2) {
        base = next;
        reset();
        return;
    }
    conditions = next;
    applyConditions();
    status = machine.update_modes(HERE);
    running = running && status === 1;
    const { time } = record.changes.length ? record.changes[record.changes.length - 1] : { time: -1 };
    if (time === instance[0]) Object.assign(record.changes[record.changes.length - 1].values, changed);
    else record.changes.push({ time: instance[0], values: changed });
    tell();
}

// --- steps

// Signals of levers from -1 to 1; they jump over the dead band, as the electronics do.
function signal({ neutral, full, overlap }, lever) {
    return neutral + (full - neutral) * (lever * (1 - overlap) + overlap * Math.sign(lever));
}

// Forces of a machine without valves: weights are carried and speeds braked, if wished.
function holdWeight() {
    const at = 8 * (scratch + 16 + 3 * part("v_a").length);
    machine.gravity(HERE, 8 * (START + given.parts.q[0]), 8 * (START + given.parts.v_a[0]), at, at);
    const weights = numbers.subarray(at / 8, at / 8 + part("v_a").length);
    for (const lever of given.levers) {
        const held = instance[lever.index] + weights[lever.column] - lever.braking * part("v_a")[lever.column];
        instance[lever.index] = lever.assumed ? held : Math.max(-lever.full, Math.min(lever.full, held));
    }
}

function advance() {
    const most = given.interval / given.ramp;
    given.levers.forEach((lever, i) => { levers[i] += Math.max(-most, Math.min(most, wanted[i] - levers[i])); });
    if (given.targets.length) hand.follow(levers);
    hand.pull();
    const before = holds ? instance.slice() : null;
    step();
    if (status !== 1 && holds) { // weights that no force carries, as at a dead centre
        holds = false;
        instance.set(before);
        step();
    }
    if (status === 1) keep();
    else running = false;
}

function step() {
    if (!given.targets.length) given.levers.forEach((lever, i) => { instance[lever.index] = signal(lever, levers[i]); });
    if (holds) holdWeight();
    for (const [name, value] of Object.entries(inputs)) instance[given.inputs[name]] = value;
    status = machine.advance(HERE);
    if (status === 1) instance[0] = given.interval * rows.length; // sums of intervals round
}

// Where the tip is: position, Jacobian and bias follow each other.
function findTip() {
    if (!given.hasTip) return [];
    machine.tip(HERE, 8 * (START + given.parts.q[0]), 8 * (START + given.parts.v_a[0]), 8 * scratch);
    return numbers.subarray(scratch, scratch + 3);
}

function keep() {
    machine.update_outputs(HERE);
    const margins = stability ? stability.margins(instance, jointVelocities()) : [];
    const row = Float64Array.from([...given.columns.map((index) => instance[index]), ...findTip(), ...margins]);
    const previous = rows[rows.length - 1];
    rows.push(row);
    spent += previous ? goals.spent(previous, row) : 0;
    const wish = goals.step(row, levers, spent, conditions);
    if (wish) setConditions(wish);
    record.results = goals.results;
}

function jointVelocities() {
    const [v, q] = [part("v_a"), part("q")];
    const at = scratch + 16 + 5 * v.length;
    machine.gamma(HERE, 8 * (START + given.parts.q[0]), 8 * at);
    const gamma = numbers.subarray(at, at + q.length * v.length);
    return Array.from(q, (_, i) => v.reduce((sum, x, j) => sum + gamma[v.length * i + j] * x, 0));
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
        computed = 0.98 * computed + given.interval * (rows.length - before);
        busy = 0.98 * busy + passed;
        if (rows.length > before || !running) tell();
    }
    last = now;
    setTimeout(lap, 4);
}

function tell() {
    postMessage({
        status, running, holds, levers, conditions, time: instance[0], factor: busy > 0.2 ? computed / busy : 1,
        hand: hand.state(), q: Array.from(part("q")), goal: goals.state(), results: record.results,
        changed: record.changed, changes: record.changes, hasMoved: rows.length > 1,
        row: rows.length ? Array.from(rows[rows.length - 1]) : [],
        before: rows.length > 1 ? Array.from(rows[rows.length - 2]) : [],
    });
}

onmessage = ({ data }) => {
    if (data.begin) begin(data.begin);
    if (data.levers) wanted = data.levers;
    if (data.inputs) Object.assign(inputs, data.inputs);
    if (data.pull !== undefined) hand.point = data.pull;
    if (data.target !== undefined) hand.goal = data.target;
    if (data.holds !== undefined) holds = data.holds;
    if (data.conditions) setConditions({ ...conditions, ...data.conditions });
    if (data.goal !== undefined) goals.choose(data.goal);
    if (data.reset) reset();
    if (data.running !== undefined) {
        running = data.running && status === 1;
        [last, due] = [performance.now(), 0];
        tell();
    }
    if (data.goal !== undefined) tell();
    if (data.take) postMessage({ rows, record, purpose: data.take });
};
