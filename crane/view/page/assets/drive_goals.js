// A goal: points that the tip passes in order. Time, energy and smoothness count as for operators.

const DWELL = 0.3; // in which the tip stays at a load that it takes or puts down [s]

const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

// Distance of a point from the segment between two others.
function fromSegment(point, a, b) {
    const along = b.map((x, i) => x - a[i]);
    const square = along.reduce((sum, x) => sum + x * x, 0);
    const share = square ? along.reduce((sum, x, i) => sum + x * (point[i] - a[i]), 0) / square : 0;
    return distance(point, a.map((x, i) => x + Math.max(0, Math.min(1, share)) * along[i]));
}

class GoalRun {
    constructor(given) {
        this.given = given;
        this.goal = null;
    }

    choose(index) {
        this.goal = index === null ? null : this.given.goals[index];
        this.index = index;
        this.restart();
    }

    begin() {
        this.results = [];
        this.restart();
    }

    restart() {
        [this.next, this.start, this.inside, this.isDone] = [0, null, 0, false];
        [this.jerk, this.fastest, this.travel, this.lowest] = [0, 0, 0, null];
        [this.squares, this.samples, this.fuel] = [0, 0, 0];
        [this.tips, this.levers] = [[], null];
    }

    // Energy between two rows: work of the pumps, else what the drives give [J].
    spent(before, row) {
        const { pump } = this.given.energy;
        this.fuel += this.fuelRate(row) * this.given.interval;
        if (pump !== null) return row[pump] - before[pump];
        return this.given.joints.reduce((sum, { force }, i) => {
            const velocity = this.given.joints.length + 1 + i;
            return force === null ? sum : sum + Math.max(0, row[force] * row[velocity]) * this.given.interval;
        }, 0);
    }

    // Of the engine [kg/s]; its governor gives the torque.
    fuelRate(row) {
        const { engine, shafts } = this.given.energy;
        if (!engine) return 0;
        let power = shafts.reduce((sum, column) => sum + row[column], 0);
        if (engine.column !== null) {
            const speed = row[engine.column];
            const share = (engine.speed + engine.droop - speed) / engine.droop;
            power = engine.torque * Math.max(0, Math.min(1, share)) * speed;
        }
        return engine.idle + engine.fuel * power;
    }

    // After a step; returns conditions that it wishes, such as a load that is taken.
    step(row, levers, energy, conditions) {
        if (!this.goal || this.isDone) return null;
        const { columns, interval } = this.given;
        const [time, tip] = [row[0], Array.from(row.subarray(columns.length, columns.length + 3))];
        if (this.start === null) {
            if (!levers.some((x) => x)) return null;
            Object.assign(this, { start: time, energy, fuel: 0, payload: conditions.payload });
        }
        this.count(tip, levers, row);
        const { points, radius, path, take, put, mass } = this.goal;
        if (path && this.next > 0) {
            this.squares += fromSegment(tip, points[this.next - 1], points[this.next]) ** 2;
            this.samples += 1;
        }
        const near = distance(tip, points[this.next]) < radius;
        const stays = this.next === take || this.next === put;
        this.inside = near ? this.inside + interval : 0;
        if (!near || (stays && this.inside < DWELL)) return null;
        const passed = this.next++;
        this.inside = 0;
        if (this.next === points.length) this.finish(time, energy);
        if (passed === take) return { ...conditions, payload: this.given.payload.masses.indexOf(mass) };
        if (passed === put) return { ...conditions, payload: this.payload };
        return null;
    }

    count(tip, levers, row) {
        const { interval, columns } = this.given;
        const [a, b, c] = this.tips;
        if (c) {
            const third = tip.map((x, i) => (x - 3 * c[i] + 3 * b[i] - a[i]) / interval ** 3);
            this.jerk += third.reduce((sum, x) => sum + x * x, 0) * interval;
        }
        if (c) this.fastest = Math.max(this.fastest, distance(tip, c) / interval);
        this.tips = [...this.tips, tip].slice(-3);
        if (this.levers) this.travel += levers.reduce((sum, x, i) => sum + Math.abs(x - this.levers[i]), 0);
        this.levers = levers.slice();
        if (this.given.stability) this.lowest = Math.min(this.lowest ?? Infinity, row[columns.length + 4]);
    }

    // Smoothness is minus the logarithm of the jerk without dimension (Hogan, Sternad 2009).
    finish(time, energy) {
        this.isDone = true;
        const duration = time - this.start;
        const result = {
            goal: this.goal.name, time: duration, energy: energy - this.energy,
            smoothness: -Math.log(duration ** 3 / this.fastest ** 2 * this.jerk), "lever travel": this.travel,
        };
        if (this.given.energy.engine) result.fuel = this.fuel;
        if (this.goal.path) result.deviation = Math.sqrt(this.squares / Math.max(1, this.samples));
        if (this.lowest !== null) result["smallest tipping margin"] = this.lowest;
        this.results = [...this.results, result];
    }

    state() {
        return { index: this.goal ? this.index : null, next: this.next, start: this.start, isDone: this.isDone, inside: this.inside / DWELL };
    }
}
