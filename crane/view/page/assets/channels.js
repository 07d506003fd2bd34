// The column of plots: groups that open and close, lines that are switched, values at the cursor.

const FOLDED = 12; // lines of a group that are all named at first

class Channels {
    constructor(page, runs, timeline) {
        this.timeline = timeline;
        this.full = timeline.end > timeline.start
            ? [timeline.start, timeline.end]
            : [timeline.start - 0.5, timeline.start + 0.5];
        this.window = this.full;
        this.time = timeline.time;
        this.panels = page.groups.map((group) => new Panel(group, runs, this));
        this.list();
        this.key(page.groups, runs);
        element("closer").onclick = () => this.zoom(0.5);
        element("wider").onclick = () => this.zoom(2);
        element("plots").addEventListener("wheel", (event) => {
            if (!event.ctrlKey) return; // the wheel alone scrolls
            event.preventDefault();
            this.zoom(event.deltaY > 0 ? 1.25 : 0.8);
        }, { passive: false });
        this.zoom(1);
        timeline.listen(({ time }) => this.update(time));
    }

    // Panels that are open in the order of the page; the others are named below them.
    list() {
        element("plots").replaceChildren(...this.panels.filter(({ open }) => open).map(({ root }) => root));
        const closed = this.panels.filter(({ open }) => !open);
        element("more").replaceChildren(...(closed.length ? ["More:"] : []), ...closed.map((panel) => {
            const textContent = panel.group.unit ? `${panel.group.title} [${panel.group.unit}]` : panel.group.title;
            return make("button", { textContent, onclick: () => this.open(panel, true) });
        }), ...(this.legend ? [this.legend] : []));
    }

    open(panel, open) {
        panel.open = open;
        this.list();
        panel.refresh();
        if (open) panel.root.scrollIntoView({ block: "nearest" });
    }

    // How lines of different meaning look, if there are several meanings.
    key(groups, runs) {
        const lines = groups.flatMap(({ lines }) => lines);
        const meanings = [["recorded", runs.length > 1 ? runs[0].label || "this run" : "recorded"]];
        if (lines.some(({ reference }) => reference)) meanings.push(["reference", "reference"]);
        if (runs.length > 1) meanings.push(["other", `over: ${runs[1].label || "second run"}`]);
        if (meanings.length === 1) return;
        this.legend = make("span", { id: "key" });
        for (const [style, words] of meanings) {
            const item = make("span");
            item.innerHTML = `<svg viewBox="0 0 26 8"><path d="M0 4h26" stroke="#1d2733" stroke-width="1.6" stroke-dasharray="${DASHES[style].join(" ")}"/></svg>`;
            item.append(words);
            this.legend.append(item);
        }
        this.list();
    }

    zoom(factor) {
        const all = this.full[1] - this.full[0];
        const wide = Math.min(Math.max((this.window[1] - this.window[0]) * factor, all / 20000, 1e-3), all);
        this.centre(wide);
        element("window").textContent = `${spoken(wide, 3)} s`;
        element("zoom").hidden = this.timeline.end === this.timeline.start;
        for (const panel of this.panels) panel.refresh();
    }

    // A window of that width about the cursor, within the recording.
    centre(wide) {
        const from = Math.min(Math.max(this.time - wide / 2, this.full[0]), this.full[1] - wide);
        this.window = [from, from + wide];
    }

    update(time) {
        this.time = time;
        const [from, to] = this.window;
        const turn = time < from || time > to;
        if (turn) this.centre(to - from);
        for (const panel of this.panels) panel.update(time, turn);
    }
}

class Panel {
    constructor(group, runs, channels) {
        this.group = group;
        this.runs = runs;
        this.channels = channels;
        this.open = group.open;
        this.decoded = new Map();
        const chips = make("div", { className: "chips" });
        this.chips = group.lines.map((line) => {
            const [value, second] = [make("b"), make("i")];
            const dot = make("span", { className: "dot" });
            dot.style.background = colourOf(line);
            const chip = make("button", { className: "chip", title: line.name }, dot, line.label, value, second);
            chip.onclick = () => {
                line.shown = !line.shown;
                this.refresh();
            };
            chips.append(chip);
            return { line, chip, value, second };
        });
        const title = make("h2", { textContent: group.title });
        title.append(make("span", { textContent: group.unit ? ` [${group.unit}]` : "" }));
        const close = make("button", {
            className: "close", title: "close", textContent: "\u00d7", onclick: () => channels.open(this, false),
        });
        close.setAttribute("aria-label", `close ${group.title}`);
        const box = make("div", { className: "canvases" });
        this.root = make("section", { className: "plot" }, make("div", { className: "title" }, title, chips, close), box);
        if (group.lines.length > FOLDED) this.fold(chips);
        this.plot = new Plot(box, channels.timeline.origin, (time) => channels.timeline.seek(time));
    }

    // Lines that are not shown are named on demand only, where there are very many.
    fold(chips) {
        const button = make("button", { className: "unfold" });
        const set = (folded) => {
            this.root.classList.toggle("folded", folded);
            button.textContent = folded ? `all ${this.group.lines.length}` : "fewer";
        };
        button.onclick = () => set(!this.root.classList.contains("folded"));
        chips.append(button);
        set(true);
    }

    // Numbers are unpacked when a line is first shown.
    series(line, kind) {
        const packed = { recorded: line.series, reference: line.reference, other: line.other }[kind];
        if (!packed) return null;
        if (!this.decoded.has(packed)) {
            this.decoded.set(packed, new Series(packed, this.runs[kind === "other" ? 1 : 0]));
        }
        return this.decoded.get(packed);
    }

    refresh() {
        if (!this.open) return;
        const lines = [];
        for (const { line, chip } of this.chips) {
            chip.setAttribute("aria-pressed", line.shown);
            if (!line.shown) continue;
            for (const style of ["other", "reference", "recorded"]) {
                const series = this.series(line, style);
                if (series) lines.push({ series, style, colour: colourOf(line), limits: style === "recorded" && line.limits });
            }
        }
        this.plot.show(lines, this.channels.window, this.channels.time);
        this.values(this.channels.time);
    }

    update(time, turned) {
        if (!this.open) return;
        if (turned) this.plot.show(this.plot.lines, this.channels.window, time);
        else this.plot.cursor(time);
        this.values(time);
    }

    values(time) {
        for (const { line, value, second } of this.chips) {
            const read = (kind) => {
                const series = line.shown && this.series(line, kind);
                const found = series ? series.at(time) : null;
                return found === null ? "" : spoken(found);
            };
            value.textContent = read("recorded");
            second.textContent = read("other");
            value.hidden = !line.shown;
            second.hidden = second.textContent === "";
        }
    }
}
