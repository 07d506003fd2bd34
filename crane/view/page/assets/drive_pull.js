// The hand of the reader on the page: the tip is pulled by a spring, or its target is moved.

const REACH = { mouse: 40, touch: 60 }; // from the tip within which a pointer takes it [pixels]
const forceText = (force) => (force < 1000 ? `${spoken(force, 3)} N` : `${spoken(force / 1000, 3)} kN`);

class Pull {
    constructor() {
        this.pane = element("pane");
        this.held = null;
        this.choice = "pull";
        this.label = make("output", { className: "pull" });
        element("space").append(this.label);
        this.arrow = space.arrow();
        this.arrow.visible = this.label.hidden = false;
        this.marker = space.ball(0.03 * space.radius, 0x2f8f4e, 0.55);
        this.marker.visible = false;
        space.marks.add(this.marker);
        if (drive.targets.length && drive.hasTip) this.addChoice();
        const note = drive.targets.length ? "Levers move the target. Dragging the tip pulls it by a spring, or moves its target; with shift the other of both." : "Drag the tip: a spring pulls it to the pointer.";
        element("facts").append(make("p", { textContent: note }));
        // before the camera's controls hear of it
        this.pane.addEventListener("pointerdown", (event) => this.take(event), { capture: true });
        window.addEventListener("pointermove", (event) => this.move(event));
        for (const kind of ["pointerup", "pointercancel", "blur"]) window.addEventListener(kind, (event) => this.release(event));
        this.pane.addEventListener("touchstart", (event) => { if (this.held !== null) event.preventDefault(); }, { capture: true, passive: false });
    }

    addChoice() {
        const buttons = { pull: "pull the tip", target: "move the target" };
        const row = make("div", { className: "hand" });
        row.setAttribute("role", "group");
        row.setAttribute("aria-label", "dragging");
        for (const [choice, text] of Object.entries(buttons)) {
            const button = make("button", { textContent: text });
            button.setAttribute("aria-pressed", choice === this.choice);
            button.onclick = () => {
                this.choice = choice;
                for (const one of row.children) one.setAttribute("aria-pressed", one === button);
            };
            row.append(button);
        }
        element("conditions").prepend(row);
    }

    // Where a point of the machine is on the pane [pixels].
    pixels(point) {
        const { x, y } = vector(point).project(viewer.camera);
        return [0.5 * (1 + x) * this.pane.clientWidth, 0.5 * (1 - y) * this.pane.clientHeight];
    }

    // The point under a pointer in the plane of the view through another point.
    under({ clientX, clientY }, point) {
        const { left, top, width, height } = this.pane.getBoundingClientRect();
        const ray = new THREE.Raycaster();
        ray.setFromCamera(new THREE.Vector2(2 * (clientX - left) / width - 1, 1 - 2 * (clientY - top) / height), viewer.camera);
        const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(viewer.camera.getWorldDirection(new THREE.Vector3()), vector(point));
        const found = ray.ray.intersectPlane(plane, new THREE.Vector3());
        return found && [found.x, -found.z, found.y];
    }

    grip(choice) { return choice === "target" ? this.target : this.tip; }

    take(event) {
        if (event.button || !this.tip || !shown || shown.status !== 1) return;
        const { left, top } = this.pane.getBoundingClientRect();
        const choice = drive.targets.length && event.shiftKey ? { pull: "target", target: "pull" }[this.choice] : this.choice;
        const [x, y] = this.pixels(this.grip(choice));
        if (Math.hypot(event.clientX - left - x, event.clientY - top - y) > (event.pointerType === "touch" ? REACH.touch : REACH.mouse)) return;
        event.preventDefault();
        event.stopImmediatePropagation();
        [this.held, this.holding] = [event.pointerId, choice];
        viewer.controls.enabled = false;
        setRunning(true);
        this.move(event);
    }

    move(event) {
        if (event.pointerId !== this.held || this.held === null) return;
        const point = this.under(event, this.grip(this.holding));
        if (point) worker.postMessage({ [this.holding]: point });
    }

    release(event) {
        if (this.held === null || (event.pointerId !== undefined && event.pointerId !== this.held)) return;
        if (this.holding === "pull") worker.postMessage({ pull: null });
        this.held = null;
        viewer.controls.enabled = true;
    }

    // Put arrow, marker and label where the state has them.
    show({ row, hand }) {
        const from = drive.columns.length;
        this.tip = row.slice(from, from + 3);
        this.target = hand.target || this.tip;
        this.marker.visible = hand.target !== null;
        this.marker.position.set(...this.target);
        const force = Math.hypot(...hand.force), end = hand.point || this.tip;
        const way = new THREE.Vector3(...hand.force), size = Math.hypot(...end.map((x, i) => x - this.tip[i]));
        this.arrow.visible = force > 0 && size > 0;
        this.label.hidden = !this.arrow.visible;
        if (!this.arrow.visible) return;
        this.arrow.position.set(...this.tip);
        this.arrow.setDirection(way.normalize());
        this.arrow.setLength(size, Math.min(0.06 * space.radius, 0.4 * size), Math.min(0.03 * space.radius, 0.2 * size));
        const [x, y] = this.pixels(end);
        this.label.textContent = forceText(force);
        this.label.style.transform = `translate(${x + 14}px, ${y - 10}px)`;
    }
}

// Gauges: the pull and the distance of the tip from its target as dials, errors of joints as rows.
const rounded = (value) => {
    const power = 10 ** Math.floor(Math.log10(value));
    return [1, 2, 5, 10].find((x) => x * power >= value) * power;
};

class HandGauges {
    constructor() {
        const [unit, size] = drive.pull && drive.pull.largest > 2000 ? ["kN", 1000] : ["N", 1];
        this.dials = [];
        if (drive.pull) this.add("pull", unit, ({ hand }) => Math.hypot(...hand.force) / size);
        if (drive.targets.length && drive.hasTip) {
            this.add("tip error", "mm", ({ row, hand }) => 1e3 * Math.hypot(...hand.target.map((x, i) => x - row[drive.columns.length + i])));
        }
        this.rows = [];
        for (const { name, unit: per, scale, column } of drive.joints) {
            const reference = drive.headers.findIndex((header) => header.startsWith(`reference_${name} [`));
            if (reference < 0) continue;
            this.rows.push({ unit: per, scale, column, reference, low: 0, high: 1e-3, ...addRow(`${name} error`, `target of ${name} less its position`, ["error"]) });
        }
    }

    add(name, unit, read) { this.dials.push(addDial({ name, unit, read, low: 0, high: 1e-3 })); }

    // The ranges grow with what was shown.
    show(state) {
        for (const dial of this.dials) {
            const value = dial.read(state);
            if (value > dial.high) dial.high = rounded(value);
            showDial(dial, state);
        }
        for (const row of this.rows) {
            const error = row.scale * (state.row[row.reference] - state.row[row.column]), size = Math.abs(error);
            if (size > row.high) row.high = rounded(size);
            row.bars[0].style.width = `${100 * share(size, row)}%`;
            row.value.textContent = `${spoken(steady(error, row), 3)} ${row.unit}`;
        }
    }
}
