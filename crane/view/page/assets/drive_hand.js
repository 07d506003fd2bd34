// The hand of the reader in the worker: a spring from the tip, and targets of a controller.

class Hand {
    constructor(given, memory) {
        this.given = given;
        [this.tip, this.rest] = [memory, memory + 6 + 3 * part("v_a").length];
        this.target = this.rest + part("v_a").length; // configuration
        this.begin();
    }

    begin() {
        [this.point, this.goal, this.force] = [null, null, [0, 0, 0]];
        numbers.set(part("q"), this.target);
        this.velocities = this.given.targets.map(() => 0);
    }

    // Position of the tip and its Jacobian by rows, at places of a configuration and velocities.
    find(q, v) {
        machine.tip(HERE, 8 * q, 8 * v, 8 * this.tip);
        const n = part("v_a").length;
        const row = (i) => Array.from(numbers.subarray(this.tip + 3 + i * n, this.tip + 3 + (i + 1) * n));
        return [Array.from(numbers.subarray(this.tip, this.tip + 3)), [0, 1, 2].map(row)];
    }

    // The force at the end of a step, from the state at its start.
    pull() {
        if (!this.given.pull) return;
        this.force = [0, 0, 0];
        if (this.point) {
            const { stiffness, damping, largest } = this.given.pull;
            const [x, jacobian] = this.find(START + this.given.parts.q[0], START + this.given.parts.v_a[0]);
            const speed = jacobian.map((row) => row.reduce((sum, a, j) => sum + a * part("v_a")[j], 0));
            const force = this.point.map((p, i) => stiffness * (p - x[i]) - damping * speed[i]);
            this.force = times(Math.min(1, largest / Math.hypot(...force)), force);
        }
        this.force.forEach((x, i) => { instance[this.given.inputs[`tip_force_${"xyz"[i]}`]] = x; });
    }

    // Ways of the targets in a step: by levers, else towards the goal of the tip.
    ways(levers) {
        const { targets, interval } = this.given;
        if (levers.some((x) => x)) this.goal = null;
        const most = targets.map(({ rate }) => rate * interval);
        if (!this.goal) return most.map((x, i) => x * levers[i]);
        const [x, jacobian] = this.find(this.target, this.rest);
        const rows = jacobian.map((row) => targets.map(({ active }, i) => row[active] * most[i]));
        const squares = rows.map((a) => rows.map((b) => a.reduce((sum, s, i) => sum + s * b[i], 0)));
        const damped = 1e-6 * (squares[0][0] + squares[1][1] + squares[2][2]);
        squares.forEach((row, i) => { row[i] += damped; });
        const [a, b, c] = squares, way = minus(this.goal, x), size = inner(a, cross(b, c));
        if (!size) return most.map(() => 0);
        const y = [cross(b, c), cross(c, a), cross(a, b)].map((column) => inner(column, way) / size);
        const shares = targets.map((_, i) => rows.reduce((sum, row, k) => sum + row[i] * y[k], 0));
        const largest = Math.max(1, ...shares.map(Math.abs));
        return most.map((x, i) => x * shares[i] / largest);
    }

    // Move the targets, as far as loops close, and give them to the controller.
    follow(levers) {
        const { targets, interval } = this.given, q = numbers.subarray(this.target, this.target + part("q").length);
        const before = Array.from(q), ways = this.ways(levers);
        targets.forEach(({ column, low, high }, i) => { q[column] = Math.max(Math.min(low, q[column]), Math.min(Math.max(high, q[column]), q[column] + ways[i])); });
        if (machine.close_loops(HERE, 8 * this.target) !== 1) q.set(before);
        const velocities = targets.map(({ column }) => (q[column] - before[column]) / interval);
        targets.forEach(({ column, inputs }, i) => {
            const values = [q[column], velocities[i], (velocities[i] - this.velocities[i]) / interval];
            inputs.forEach((indices, k) => indices.forEach((index) => { instance[index] = values[k]; }));
        });
        this.velocities = velocities;
    }

    state() {
        const target = this.given.hasTip && this.given.targets.length ? this.find(this.target, this.rest)[0] : null;
        return { force: this.force, point: this.point, target, goal: this.goal };
    }
}
