// Margins against tipping, as `crane.dynamics.TippingStability`: static and with inertial forces.

const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (s, a) => [s * a[0], s * a[1], s * a[2]];
const inner = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

class Stability {
    constructor(given) {
        Object.assign(this, given.stability);
        this.payload = given.payload;
        this.tree = new Tree(given.tree);
        [this.q] = given.parts.q;
    }

    load(index) {
        if (this.payload && this.payload.bodies.length) this.bodies = this.payload.bodies[index];
        this.mass = this.bodies.reduce((sum, [mass]) => sum + mass, 0);
    }

    // Smallest margins of a state: with inertial forces, and static.
    margins(instance, v) {
        const g = Array.from(instance.subarray(this.gravity, this.gravity + 3));
        const poses = this.tree.poses(instance.subarray(this.q, this.q + v.length));
        const supports = this.supports.map((place) => this.origin(poses, place));
        const still = this.rest(this.weight(poses, null, g), poses, instance);
        const moving = this.isStationary
            ? this.rest(this.weight(poses, { v, a: instance.subarray(this.accelerations) }, g), poses, instance)
            : this.contacts(poses, instance);
        return [moving, still].map((wrench) => this.smallest(supports, wrench, Math.hypot(...g)));
    }

    origin(poses, place) { return Array.from(this.tree.pose(poses, place).subarray(12, 15)); }

    // Force and moment about the origin that carry the bodies in their motion.
    weight(poses, motion, g) {
        const still = { o: [0, 0, 0], w: [0, 0, 0], alpha: [0, 0, 0], a: [0, 0, 0] };
        const own = this.bodies[0], parts = [];
        let [force, moment] = [times(-own[0], g), times(-own[0], cross(own.slice(1, 4), g))];
        this.tree.joints.forEach((joint, i) => {
            const pose = poses[i], parent = joint.parent < 0 ? still : parts[joint.parent];
            const body = { ...still, o: Array.from(pose.subarray(12, 15)) };
            if (motion) this.move(body, parent, joint, turned(pose, joint.axis), motion);
            parts.push(body);
            const [mass, x, y, z, xx, xy, yy, xz, yz, zz] = this.bodies[i + 1];
            const lever = turned(pose, [x, y, z]);
            const at = plus(body.a, plus(cross(body.alpha, lever), cross(body.w, cross(body.w, lever))));
            const pushed = times(mass, minus(at, g));
            force = plus(force, pushed);
            moment = plus(moment, cross(plus(body.o, lever), pushed));
            if (!motion) return;
            const inertia = (u) => {
                const [a, b, c] = [0, 1, 2].map((k) => inner(pose.subarray(4 * k, 4 * k + 3), u));
                return turned(pose, [xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c]);
            };
            moment = plus(moment, plus(inertia(body.alpha), cross(body.w, inertia(body.w))));
        });
        return [force, moment];
    }

    // Velocity and acceleration of a body from those of its parent.
    move(body, parent, joint, axis, { v, a }) {
        const [speed, rate] = [times(v[joint.column], axis), times(a[joint.column], axis)];
        const lever = minus(body.o, parent.o);
        body.a = plus(parent.a, plus(cross(parent.alpha, lever), cross(parent.w, cross(parent.w, lever))));
        [body.w, body.alpha] = [parent.w, parent.alpha];
        if (joint.type === "prismatic") {
            body.a = plus(body.a, plus(rate, times(2, cross(parent.w, speed))));
        } else {
            body.alpha = plus(plus(parent.alpha, rate), cross(parent.w, speed));
            body.w = plus(parent.w, speed);
        }
    }

    external(poses, instance, { first, frame }) {
        const force = Array.from(instance.subarray(first, first + 3));
        return [force, plus(Array.from(instance.subarray(first + 3, first + 6)), cross(this.origin(poses, frame), force))];
    }

    // What remains for the ground beside the other external forces.
    rest(wrench, poses, instance) {
        return this.forces.filter((force) => !force.supports)
            .map((force) => this.external(poses, instance, force))
            .reduce(([f, m], [push, turn]) => [minus(f, push), minus(m, turn)], wrench);
    }

    contacts(poses, instance) {
        return this.forces.filter((force) => force.supports)
            .map((force) => this.external(poses, instance, force))
            .reduce(([f, m], [push, turn]) => [plus(f, push), plus(m, turn)], [[0, 0, 0], [0, 0, 0]]);
    }

    smallest(supports, [force, moment], g) {
        return Math.min(...this.lines.map(([i, j]) => {
            const [from, line] = [supports[i], minus(supports[j], supports[i])];
            const about = inner(line, minus(moment, cross(from, force))) / Math.hypot(...line);
            const far = Math.max(...supports.map((p) => Math.abs(line[0] * (p[1] - from[1]) - line[1] * (p[0] - from[0]))));
            return about / (this.mass * g * far / Math.hypot(line[0], line[1]));
        }));
    }
}
