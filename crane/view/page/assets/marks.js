// What is drawn on the machine: forces, the tip's way, centres of mass, pins.

const COLOURS = { push: "#cf4520", pull: "#1d63c9", tip: "#0d7d72", reference: "#e39a12", mass: "#1d2733", payload: "#7a3db8", pin: "#5d6b7a", load: "#b0257d", spring: "#56616d" };
const FULL_TURN = 1.7 * Math.PI; // what the largest torque winds

// Always visible, also within a cylinder's barrel.
const onTop = (colour) => new THREE.MeshBasicMaterial({ color: colour, depthTest: false, transparent: true });

// A straight arrow: out of the actuator where it pushes, into it where it pulls.
class StraightArrow {
    constructor(size) {
        this.full = 0.3 * size;
        this.head = 0.042 * size;
        this.material = onTop(COLOURS.push);
        this.shaft = new THREE.Mesh(new THREE.CylinderGeometry(0.0065 * size, 0.0065 * size, 1, 16), this.material);
        this.tip = new THREE.Mesh(new THREE.ConeGeometry(0.018 * size, 1, 24), this.material);
        this.object = new THREE.Group();
        this.object.add(this.shaft, this.tip);
    }

    set(origin, axis, share) {
        const length = Math.min(Math.abs(share), 1.2) * this.full;
        const head = Math.min(this.head, length);
        this.object.visible = length > 0.01 * this.full;
        this.object.position.fromArray(origin);
        const along = new THREE.Vector3(...axis).multiplyScalar(Math.sign(share) || 1).normalize();
        this.object.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along);
        this.shaft.scale.y = Math.max(length - head, 1e-9);
        this.shaft.position.y = (length - head) / 2;
        this.tip.scale.y = head;
        this.tip.position.y = length - head / 2;
        paint(this.material, share);
    }
}

// An arc about the axis, wound as far as the torque is large.
class RoundArrow {
    constructor(size) {
        this.radius = 0.085 * size;
        this.head = 0.038 * size;
        this.material = onTop(COLOURS.push);
        const circle = new THREE.Curve();
        circle.getPoint = (t) => new THREE.Vector3(this.radius * Math.cos(t * FULL_TURN), this.radius * Math.sin(t * FULL_TURN), 0);
        this.segments = 96;
        this.arc = new THREE.Mesh(new THREE.TubeGeometry(circle, this.segments, 0.0055 * size, 10), this.material);
        this.tip = new THREE.Mesh(new THREE.ConeGeometry(0.016 * size, this.head, 24), this.material);
        this.object = new THREE.Group();
        this.object.add(this.arc, this.tip);
    }

    set(origin, axis, share) {
        const angle = Math.min(Math.abs(share), 1.0) * FULL_TURN;
        this.object.visible = Math.abs(share) > 0.02;
        this.object.position.fromArray(origin);
        const along = new THREE.Vector3(...axis).multiplyScalar(Math.sign(share) || 1).normalize();
        this.object.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), along);
        const count = Math.max(1, Math.round(this.segments * angle / FULL_TURN));
        this.arc.geometry.setDrawRange(0, 60 * count); // ten sides of two triangles
        const end = count / this.segments * FULL_TURN;
        this.tip.position.set(this.radius * Math.cos(end), this.radius * Math.sin(end), 0);
        this.tip.rotation.z = end;
        this.tip.scale.setScalar(Math.min(1, 0.6 * this.radius * end / this.head));
        paint(this.material, share);
    }
}

// A spring, damper, gas strut or rope between two points, as long as they are apart.
class Link {
    constructor(parts, size, length, least) {
        const radius = Math.min(0.025 * size, 0.15 * length);
        const steel = new THREE.MeshPhongMaterial({ color: COLOURS.spring });
        const bar = (thick) => new THREE.Mesh(new THREE.CylinderGeometry(thick, thick, 1, 16), steel);
        this.object = new THREE.Group();
        this.long = []; // parts of unit length along y, which follow it
        if (parts.includes("coil")) {
            const turns = 9, straight = 0.1; // of its length at each end
            const coil = new THREE.Curve();
            coil.getPoint = (t) => {
                const wound = Math.min(Math.max((t - straight) / (1 - 2 * straight), 0), 1);
                const out = radius * Math.min(1, 12 * wound, 12 * (1 - wound));
                const angle = 2 * Math.PI * turns * wound;
                return new THREE.Vector3(out * Math.cos(angle), t * length, out * Math.sin(angle));
            };
            const wire = new THREE.Mesh(new THREE.TubeGeometry(coil, 300, 0.13 * radius, 8), steel);
            this.long.push([wire, (now) => { wire.scale.y = now / length; }]);
        }
        if (parts.includes("strut")) {
            const [barrel, rod] = [bar(0.5 * radius), bar(0.22 * radius)];
            barrel.scale.y = 0.7 * least;
            barrel.position.y = 0.35 * least;
            this.object.add(barrel);
            this.long.push([rod, (now) => { [rod.scale.y, rod.position.y] = [now, now / 2]; }]);
        }
        if (parts.includes("line")) {
            const line = bar(0.16 * radius);
            this.long.push([line, (now) => { [line.scale.y, line.position.y] = [now, now / 2]; }]);
        }
        this.object.add(...this.long.map(([part]) => part));
        this.object.traverse((item) => { item.castShadow = item.isMesh === true; });
    }

    set(start, end) {
        const way = new THREE.Vector3(...end).sub(new THREE.Vector3(...start));
        const now = way.length();
        this.object.visible = now > 0;
        if (!now) return;
        this.object.position.fromArray(start);
        this.object.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), way.divideScalar(now));
        for (const [, follow] of this.long) follow(now);
    }
}

// Pale where the force is small, full where it is large; red pushes, blue pulls.
function paint(material, share) {
    material.color.set(share < 0 ? COLOURS.pull : COLOURS.push);
    material.color.lerp(new THREE.Color(0xffffff), 0.45 * (1 - Math.min(Math.abs(share), 1)));
}

// A sign of constant size on the screen, drawn by a function on a canvas of 64 x 64.
function sign(draw, pixels) {
    const canvas = make("canvas", { width: 64, height: 64 });
    const pen = canvas.getContext("2d");
    pen.lineWidth = 5;
    draw(pen);
    const map = new THREE.CanvasTexture(canvas);
    const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthTest: false, sizeAttenuation: false }));
    const fit = () => {
        const height = Math.max(element("pane").clientHeight, 1);
        sprite.scale.setScalar(2 * Math.tan(viewer.camera.fov * Math.PI / 360) * pixels / height);
    };
    fit();
    new ResizeObserver(fit).observe(element("pane"));
    return sprite;
}

function disc(pen, fill, radius = 27) {
    pen.beginPath();
    pen.arc(32, 32, radius, 0, 2 * Math.PI);
    pen.fillStyle = fill;
    pen.fill();
}

function ring(pen, colour) {
    pen.beginPath();
    pen.arc(32, 32, 27, 0, 2 * Math.PI);
    pen.strokeStyle = colour;
    pen.stroke();
}

// The sign of drawings: a disc in quarters.
function quarters(colour) {
    return (pen) => {
        disc(pen, "#ffffff");
        for (const start of [0, Math.PI]) {
            pen.beginPath();
            pen.moveTo(32, 32);
            pen.arc(32, 32, 27, start, start + Math.PI / 2);
            pen.fillStyle = colour;
            pen.fill();
        }
        ring(pen, colour);
    };
}

function pinSign(pen) {
    disc(pen, "#ffffff", 24);
    ring(pen, COLOURS.pin);
    disc(pen, COLOURS.pin, 9);
}

// Three digits with a prefix: 12500 is "12.5 k".
function metric(value) {
    const steps = [[1e6, "M"], [1e3, "k"], [1, ""]];
    const [unit, prefix] = steps.find(([least]) => value >= least) || [1, ""];
    return `${Number((value / unit).toPrecision(3))} ${prefix}`;
}

// At most 6000 of so many frames, evenly: enough for a line on the screen.
function some(count) {
    const kept = Math.min(count, 6000);
    return Array.from({ length: kept }, (_, i) => Math.round(i * (count - 1) / Math.max(kept - 1, 1)));
}

// A thin tube through points, as lines of more than one pixel are not drawn everywhere.
function tube(points, radius, colour) {
    const sides = 4;
    const positions = [];
    const index = [];
    points.forEach((point, i) => {
        const ahead = new THREE.Vector3(...points[Math.min(i + 1, points.length - 1)]);
        const along = ahead.sub(new THREE.Vector3(...points[Math.max(i - 1, 0)]));
        if (along.lengthSq() === 0) along.set(1, 0, 0);
        const side = new THREE.Vector3(0, 0, 1).cross(along);
        if (side.lengthSq() < 1e-12 * along.lengthSq()) side.set(0, 1, 0);
        side.normalize();
        const other = side.clone().cross(along.normalize());
        for (let k = 0; k < sides; k++) {
            const [c, s] = [Math.cos(2 * Math.PI * k / sides), Math.sin(2 * Math.PI * k / sides)];
            for (const axis of ["x", "y", "z"]) {
                positions.push(point["xyz".indexOf(axis)] + radius * (c * side[axis] + s * other[axis]));
            }
            if (i + 1 < points.length) {
                const [a, b] = [sides * i + k, sides * i + (k + 1) % sides];
                index.push(a, b, a + sides, b, b + sides, a + sides);
            }
        }
    });
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
    geometry.setIndex(index);
    return new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color: colour, side: THREE.DoubleSide }));
}

// All marks, in layers that can be switched: {forces: {title, colours, object}, ...}.
class Marks {
    constructor(page, space, motion) {
        this.space = space;
        this.tree = space.tree;
        this.motion = motion;
        this.layers = {};
        this.moving = [];
        const size = 2 * space.radius;
        this.arrows = page.actuators.map((actuator) => {
            const joint = this.tree.joints[actuator.joint];
            const arrow = joint.type === "revolute" ? new RoundArrow(size) : new StraightArrow(size);
            return { ...actuator, axis: joint.axis, share: floats(actuator.share), arrow };
        });
        if (this.arrows.length) {
            const kinds = new Set(page.actuators.map(({ joint }) => this.tree.joints[joint].type));
            const words = kinds.has("prismatic") ? "push, pull" : "torque +, \u2212";
            this.add("forces", words, [COLOURS.push, COLOURS.pull], this.arrows.map(({ arrow }) => arrow.object));
        }
        this.loads = page.loads.map((load) => {
            const arrow = new StraightArrow(size);
            return { ...load, share: load.share.map(floats), arrow };
        });
        if (this.loads.length) {
            for (const { arrow } of this.loads) arrow.material.color.set(COLOURS.load);
            const title = `loads, ${metric(page.loads[0].full)}N at full length`;
            this.add("loads", title, [COLOURS.load], this.loads.map(({ arrow }) => arrow.object));
        }
        this.springs = page.springs.map(({ name, ends, parts, length, least }) => (
            { name, ends, link: new Link(parts, size, length || least || size, least) }));
        if (this.springs.length) {
            this.add("springs", "springs", [COLOURS.spring], this.springs.map(({ link }) => link.object));
        }
        if (page.tip && motion.time.length > 1) {
            const way = some(motion.time.length).map((k) => this.tipAt(page.tip, motion.frame(k)));
            this.add("path", "tip path", [COLOURS.tip], [tube(way, 0.0022 * size, COLOURS.tip)]);
        }
        if (page.reference) {
            const wanted = floats(page.reference);
            const way = some(wanted.length / 3).map((k) => wanted.slice(3 * k, 3 * k + 3));
            if (way.length > 1) this.add("reference", "reference", [COLOURS.reference], [tube(way, 0.0018 * size, COLOURS.reference)]);
        }
        const mass = sign(quarters(COLOURS.mass), 20);
        this.moving.push((poses) => mass.position.fromArray(this.tree.centre(poses)));
        this.add("mass", "centre of mass", [COLOURS.mass], [mass]);
        this.attach("payload", "payload", COLOURS.payload, page.payload ? [page.payload] : [], quarters(COLOURS.payload), 20);
        this.attach("pins", "loop pins", COLOURS.pin, page.pins, pinSign, 11);
    }

    tipAt(tip, q) {
        return Array.from(this.tree.pose(this.tree.poses(q), tip).slice(12, 15));
    }

    add(name, title, colours, objects) {
        const object = new THREE.Group();
        object.add(...objects);
        object.traverse((item) => { item.renderOrder = item.isSprite ? 20 : 10; });
        viewer.scene.add(object);
        this.layers[name] = { title, colours, object };
    }

    attach(name, title, colour, places, draw, pixels) {
        if (!places.length) return;
        const sprites = places.map((place) => {
            const sprite = sign(draw, pixels);
            this.moving.push((poses) => sprite.position.fromArray(this.tree.pose(poses, place).slice(12, 15)));
            return sprite;
        });
        this.add(name, title, [colour], sprites);
    }

    update(time, poses) {
        for (const { joint, at, axis, share, arrow } of this.arrows) {
            arrow.set(moved(poses[joint], at), turned(poses[joint], axis), this.motion.read(share, time));
        }
        for (const { place, share, arrow } of this.loads) {
            const force = share.map((part) => this.motion.read(part, time));
            arrow.set(Array.from(this.tree.pose(poses, place).slice(12, 15)), force, Math.hypot(...force));
            arrow.material.color.set(COLOURS.load);
        }
        for (const { ends, link } of this.springs) {
            link.set(...ends.map((place) => Array.from(this.tree.pose(poses, place).slice(12, 15))));
        }
        for (const move of this.moving) move(poses);
        viewer.set_dirty();
    }
}
