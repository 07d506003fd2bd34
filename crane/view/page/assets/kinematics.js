// Forward kinematics of the tree of joints. Poses are 16 numbers, column by column, z up, metres.

function product(a, b) {
    const c = new Float64Array(16);
    for (let j = 0; j < 4; j++) {
        const [x, y, z, w] = [b[4 * j], b[4 * j + 1], b[4 * j + 2], j === 3 ? 1 : 0];
        for (let i = 0; i < 3; i++) c[4 * j + i] = a[i] * x + a[4 + i] * y + a[8 + i] * z + a[12 + i] * w;
    }
    c[15] = 1;
    return c;
}

function moved(pose, [x, y, z]) {
    return [0, 1, 2].map((i) => pose[i] * x + pose[4 + i] * y + pose[8 + i] * z + pose[12 + i]);
}

function turned(pose, [x, y, z]) {
    return [0, 1, 2].map((i) => pose[i] * x + pose[4 + i] * y + pose[8 + i] * z);
}

const STILL = Float64Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);

// What a joint does at its coordinates: slide along its axis, or turn about it (Rodrigues).
function displacement({ type, axis: [x, y, z] }, [value, ...more]) {
    if (type === "floating") return flown([value, ...more]);
    if (type === "ball") return flown([0, 0, 0, value, ...more]);
    if (type === "prismatic") {
        return Float64Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x * value, y * value, z * value, 1);
    }
    return rotation([x, y, z], value);
}

// About a unit axis by an angle (Rodrigues).
function rotation([x, y, z], value) {
    const [s, c] = [Math.sin(value), Math.cos(value)];
    const h = 2 * Math.sin(value / 2) ** 2; // 1 - cos without cancellation
    return Float64Array.of(
        c + h * x * x, h * x * y + s * z, h * x * z - s * y, 0,
        h * x * y - s * z, c + h * y * y, h * y * z + s * x, 0,
        h * x * z + s * y, h * y * z - s * x, c + h * z * z, 0,
        0, 0, 0, 1,
    );
}

// A body that floats, by place and rotation vector.
function flown([x, y, z, a, b, c]) {
    const angle = Math.hypot(a, b, c);
    const pose = angle ? rotation([a / angle, b / angle, c / angle], angle) : Float64Array.from(STILL);
    pose.set([x, y, z], 12);
    return pose;
}

class Tree {
    constructor({ joints, links }) {
        this.joints = joints;
        this.links = links;
        this.mass = joints.reduce((sum, joint) => sum + joint.mass, 0);
    }

    // Poses of all joints' frames at a posture q.
    poses(q) {
        const found = [];
        for (const joint of this.joints) {
            const parent = joint.parent < 0 ? STILL : found[joint.parent];
            const zero = product(parent, joint.placement);
            found.push(product(zero, displacement(joint, q.slice(joint.column, joint.column + 6))));
        }
        return found;
    }

    // Pose of a place {joint, placement}; joint -1 is the world.
    pose(poses, place) {
        return place.joint < 0 ? Float64Array.from(place.placement) : product(poses[place.joint], place.placement);
    }

    // Centre of mass of everything that moves.
    centre(poses) {
        const sum = [0, 0, 0];
        this.joints.forEach((joint, i) => {
            moved(poses[i], joint.lever).forEach((x, k) => { sum[k] += joint.mass * x; });
        });
        return sum.map((x) => x / this.mass);
    }
}

// Recorded postures. At a frame's time q is exactly what was recorded, between frames a line.
class Motion {
    constructor({ time, q }, shift = 0) {
        this.time = doubles(time).map((t) => t + shift);
        this.columns = q.map((column) => coordinates(column, this.time.length));
    }

    get start() { return this.time[0]; }
    get end() { return this.time[this.time.length - 1]; }

    frame(k) { return this.columns.map((column) => column[k]); }

    // Frame before a time, and the share of the way to the next one.
    between(time) {
        const last = this.time.length - 1;
        const k = Math.min(Math.max(firstFrom(this.time, time), 0), last);
        if (this.time[k] === time || k === 0 || time > this.time[last]) return [k, 0];
        return [k - 1, (time - this.time[k - 1]) / (this.time[k] - this.time[k - 1])];
    }

    at(time) {
        const [k, share] = this.between(time);
        if (!share) return this.frame(k);
        return this.columns.map((column) => (1 - share) * column[k] + share * column[k + 1]);
    }

    // A column of numbers per frame, read in between in the same way.
    read(values, time) {
        const [k, share] = this.between(time);
        return share ? (1 - share) * values[k] + share * values[k + 1] : values[k];
    }
}
