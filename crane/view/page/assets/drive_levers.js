// Levers: two sticks by keys, touch and gamepad, in the pattern of the page; others by sliders.

// The lever on each axis: left x and y, right x and y; x to the right, y forwards.
const PATTERNS = {
    ISO: ["slew", "stick", "tool", "boom"],
    SAE: ["slew", "boom", "tool", "stick"],
};
const KEYS = [["KeyD", "KeyA"], ["KeyW", "KeyS"], ["KeyL", "KeyJ"], ["KeyI", "KeyK"]];
const ARROWS = [[], [], ["ArrowRight", "ArrowLeft"], ["ArrowUp", "ArrowDown"]];
const MORE_KEYS = [["KeyR", "KeyF"], ["KeyT", "KeyG"], ["KeyY", "KeyH"]];
const PAD_BUTTONS = [[7, 6], [5, 4], [12, 13]]; // of further levers: triggers, shoulders, cross
const FINE = 0.4; // of the way, with shift
const keyName = (code) => code.replace("Key", "").replace("Arrow", "").toLowerCase();

const memory = {
    get(name) { try { return window.localStorage.getItem(`crane ${name}`); } catch { return null; } },
    set(name, value) { try { window.localStorage.setItem(`crane ${name}`, value); } catch { /* a page from a file may have none */ } },
};

class Levers {
    constructor(levers) {
        this.levers = levers;
        this.held = new Set();
        this.fine = false;
        this.touched = [0, 0, 0, 0]; // axes of the sticks
        this.slid = levers.map(() => 0);
        this.pattern = PATTERNS[memory.get("pattern")] ? memory.get("pattern") : "ISO";
        this.further = levers.map((_, i) => i).filter((i) => !levers[i].role);
        this.sticks = [0, 1].map((side) => this.addStick(side)).filter((stick) => stick);
        this.rows = this.further.map((i, k) => this.addSlider(i, k));
        this.label();
    }

    // The lever on an axis, and its index.
    on(axis) {
        const i = this.levers.findIndex(({ role }) => role === PATTERNS[this.pattern][axis]);
        return i < 0 ? null : i;
    }

    choose(pattern) {
        this.pattern = pattern;
        memory.set("pattern", pattern);
        this.label();
    }

    addStick(side) {
        if (this.levers.every(({ role }) => !role)) return null;
        const knob = make("i"), bars = [0, 1].map((k) => make("u", { className: "xy"[k] }));
        const names = ["right", "left", "up", "down"].map((place) => make("span", { className: place }));
        const pad = make("div", { className: "pad" }, ...bars, knob);
        const stick = make("div", { className: `stick ${["left", "right"][side]}` }, pad, ...names);
        stick.setAttribute("aria-label", `${["left", "right"][side]} lever`);
        element("sticks").append(stick);
        const move = (event) => {
            const { left, top, width } = pad.getBoundingClientRect();
            const way = [event.clientX - left - width / 2, top + width / 2 - event.clientY].map((x) => x / (0.38 * width));
            way.forEach((x, k) => { this.touched[2 * side + k] = Math.max(-1, Math.min(1, bent(x))); });
        };
        const release = () => { this.touched[2 * side] = this.touched[2 * side + 1] = 0; };
        pad.addEventListener("pointerdown", (event) => {
            pad.setPointerCapture(event.pointerId);
            move(event);
            setRunning(true);
        });
        pad.addEventListener("pointermove", (event) => { if (pad.hasPointerCapture(event.pointerId)) move(event); });
        for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(kind, release);
        return { side, knob, bars, names, stick };
    }

    addSlider(i, k) {
        const lever = this.levers[i], keys = MORE_KEYS[k];
        const slider = make("input", { type: "range", min: -1, max: 1, step: "any", value: 0 });
        slider.setAttribute("aria-label", lever.name);
        slider.oninput = () => {
            this.slid[i] = Number(slider.value);
            setRunning(true);
        };
        const release = () => { this.slid[i] = slider.value = 0; };
        for (const kind of ["pointerup", "pointercancel", "blur"]) slider.addEventListener(kind, release);
        const title = make("span", { textContent: keys ? keys.map(keyName).join(" ") : "" });
        element("others").append(make("label", { className: "lever" }, make("b", { textContent: lever.name, title: lever.name }), slider, title));
        return { i, slider };
    }

    // What each direction of the sticks does, in the pattern.
    label() {
        for (const { side, names, stick } of this.sticks) {
            names.forEach((label, place) => {
                const axis = 2 * side + (place > 1 ? 1 : 0), i = this.on(axis);
                const word = i === null ? "" : this.levers[i].words[place % 2];
                const key = make("kbd", { textContent: keyName(KEYS[axis][place % 2]) });
                label.replaceChildren(...(i === null ? [] : [key, `${this.levers[i].name.replaceAll("_", "_\u200b")} ${word}`]));
                label.title = label.textContent;
            });
            stick.hidden = this.on(2 * side) === null && this.on(2 * side + 1) === null;
        }
    }

    fromKeys([up, down]) { return ((this.held.has(up) ? 1 : 0) - (this.held.has(down) ? 1 : 0)) * (this.fine ? FINE : 1); }

    // Axes of the sticks and values of further levers of the first gamepad.
    gamepad() {
        const pad = Array.from(navigator.getGamepads ? navigator.getGamepads() : []).find((one) => one && one.axes.length > 3);
        if (!pad) return { axes: [0, 0, 0, 0], more: [] };
        const axes = pad.axes.slice(0, 4).map((x, k) => bent(k % 2 ? -x : x));
        const pressed = (k) => (pad.buttons[k] ? pad.buttons[k].value : 0);
        return { axes, more: PAD_BUTTONS.map(([up, down]) => pressed(up) - pressed(down)) };
    }

    wanted() {
        const { axes, more } = this.gamepad();
        const found = this.slid.slice();
        for (let axis = 0; axis < 4; axis++) {
            const i = this.on(axis);
            if (i === null) continue;
            const way = this.touched[axis] + axes[axis] + this.fromKeys(KEYS[axis]) + this.fromKeys(ARROWS[axis]);
            found[i] += this.levers[i].sign * way;
        }
        this.further.forEach((i, k) => { found[i] += (more[k] || 0) + (MORE_KEYS[k] ? this.fromKeys(MORE_KEYS[k]) : 0); });
        return found.map((x) => Math.max(-1, Math.min(1, x)));
    }

    show(levers) {
        for (const { side, knob, bars } of this.sticks) {
            const at = [0, 1].map((k) => {
                const i = this.on(2 * side + k);
                return i === null ? 0 : this.levers[i].sign * levers[i];
            });
            knob.style.transform = `translate(${38 * at[0]}%, ${-38 * at[1]}%)`;
            bars.forEach((bar, k) => bar.style.setProperty("--way", at[k]));
        }
        for (const { i, slider } of this.rows) if (document.activeElement !== slider) slider.value = levers[i];
    }
}

// Nothing near the middle, then smoothly to the end.
function bent(x) {
    const way = Math.max(0, Math.abs(x) - 0.12) / 0.88;
    return Math.sign(x) * Math.min(1, way);
}

function listenToKeys(levers) {
    const known = new Set([...KEYS, ...ARROWS, ...MORE_KEYS].flat());
    window.addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.metaKey || event.altKey) return;
        levers.fine = event.shiftKey;
        const typing = /SELECT|INPUT/.test(event.target.tagName) && event.code.startsWith("Arrow");
        if (event.code === "Space" && event.target.tagName !== "SELECT") {
            event.preventDefault();
            setRunning(!(shown && shown.running));
        } else if (known.has(event.code) && !typing) {
            if (event.code.startsWith("Arrow")) event.preventDefault();
            levers.held.add(event.code);
            if (!event.repeat) setRunning(true);
        }
    });
    window.addEventListener("keyup", (event) => {
        levers.fine = event.shiftKey;
        levers.held.delete(event.code);
    });
    window.addEventListener("blur", () => levers.held.clear());
}
