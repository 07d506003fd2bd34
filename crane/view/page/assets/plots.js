// One plot: lines over time on a canvas, a cursor on a second one above it.

const HUES = ["#1f5fa8", "#d1642a", "#2c8a4f", "#8446b8", "#b3861b", "#bf2f5b", "#0c8798", "#59656f"];
const SHADES = ["#6ea3dc", "#eda27a", "#79c497", "#b993dc", "#dcbf6b", "#e486a3", "#6cc2cd", "#a0abb5"];
const colourOf = ({ hue, shade }) => (shade % 2 ? SHADES : HUES)[(hue + 3 * (shade >> 1)) % HUES.length];
const DASHES = { recorded: [], reference: [2, 3], other: [7, 4] };
const MARGIN = { left: 46, right: 8, top: 6, bottom: 17 };
const FONT = "10.5px system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif";

// Values of one column of one run: lowest and highest per span, and at the frames.
class Series {
    constructor(packed, run) {
        this.run = run;
        this.low = floats(packed.low);
        this.high = packed.high ? floats(packed.high) : this.low;
        this.frames = packed.frames ? floats(packed.frames) : null;
    }

    // The recorded value at the frame nearest to a time.
    at(time) {
        const { motion, rows } = this.run;
        if (time < motion.start - 1e-9 || time > motion.end + 1e-9) return null;
        const frame = nearest(motion.time, time);
        return this.frames ? this.frames[frame] : this.low[rows[frame]];
    }

    // Indices of the values within a time window, and one beyond at each side.
    range([from, to]) {
        const { axis } = this.run;
        return [Math.max(firstFrom(axis, from) - 1, 0), Math.min(firstFrom(axis, to) + 1, axis.length)];
    }
}

class Plot {
    constructor(box, origin, onSeek) {
        this.box = box;
        this.origin = origin; // of the times that are written
        this.base = box.appendChild(make("canvas"));
        this.top = box.appendChild(make("canvas"));
        this.lines = [];
        new ResizeObserver(() => this.draw()).observe(box);
        const seek = (event) => {
            const x = event.clientX - box.getBoundingClientRect().left;
            const share = (x - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right);
            onSeek(this.window[0] + Math.min(Math.max(share, 0), 1) * (this.window[1] - this.window[0]));
        };
        box.addEventListener("pointerdown", (event) => {
            box.setPointerCapture(event.pointerId);
            seek(event);
        });
        box.addEventListener("pointermove", (event) => {
            if (box.hasPointerCapture(event.pointerId)) seek(event);
        });
    }

    // lines: [{series, colour, style, limits}]; window: [from, to].
    show(lines, window, time) {
        [this.lines, this.window, this.time] = [lines, window, time];
        this.draw();
    }

    fit() {
        [this.width, this.height] = [this.box.clientWidth, this.box.clientHeight];
        const density = window.devicePixelRatio || 1;
        for (const canvas of [this.base, this.top]) {
            canvas.width = Math.round(this.width * density);
            canvas.height = Math.round(this.height * density);
            canvas.getContext("2d").setTransform(density, 0, 0, density, 0, 0);
        }
    }

    // Lowest and highest value in the window, with some air; noise of what rests stays flat.
    span() {
        let [low, high] = [Infinity, -Infinity];
        for (const { series } of this.lines) {
            const [first, end] = series.range(this.window);
            for (let i = first; i < end; i++) {
                if (series.low[i] < low) low = series.low[i];
                if (series.high[i] > high) high = series.high[i];
            }
        }
        if (low > high) return [0, 1];
        const least = Math.max(1e-3 * Math.max(Math.abs(low), Math.abs(high)), 1e-2);
        const lacking = Math.max(0, least - (high - low));
        const air = 0.08 * (high - low + lacking);
        return [low - lacking / 2 - air, high + lacking / 2 + air];
    }

    x(time) {
        const [from, to] = this.window;
        return MARGIN.left + (time - from) / (to - from) * (this.width - MARGIN.left - MARGIN.right);
    }

    y(value) {
        return this.height - MARGIN.bottom - (value - this.low) / (this.high - this.low) * (this.height - MARGIN.top - MARGIN.bottom);
    }

    draw() {
        if (!this.window || !this.box.clientWidth) return;
        this.fit();
        [this.low, this.high] = this.span();
        const pen = this.base.getContext("2d");
        pen.clearRect(0, 0, this.width, this.height);
        this.grid(pen);
        pen.save();
        pen.beginPath();
        pen.rect(MARGIN.left, 0, this.width - MARGIN.left - MARGIN.right, this.height - MARGIN.bottom + 1);
        pen.clip();
        for (const line of this.lines) this.limits(pen, line);
        for (const line of this.lines) this.line(pen, line);
        pen.restore();
        this.cursor(this.time);
    }

    grid(pen) {
        pen.font = FONT;
        pen.fillStyle = "#5d6b7a";
        pen.strokeStyle = "#e6eaee";
        pen.lineWidth = 1;
        const [right, bottom] = [this.width - MARGIN.right, this.height - MARGIN.bottom];
        const across = ticks(this.low, this.high, Math.max(2, (bottom - MARGIN.top) / 26));
        pen.textAlign = "right";
        pen.textBaseline = "middle";
        for (const value of across.values) {
            const y = Math.round(this.y(value)) + 0.5;
            stroke(pen, MARGIN.left, y, right, y);
            pen.fillText(across.text(value), MARGIN.left - 5, y);
        }
        const along = ticks(this.window[0] - this.origin, this.window[1] - this.origin, Math.max(2, (right - MARGIN.left) / 75));
        pen.textBaseline = "alphabetic";
        along.values.forEach((value, i) => {
            const x = Math.round(this.x(value + this.origin)) + 0.5;
            stroke(pen, x, MARGIN.top, x, bottom);
            const text = along.text(value) + (i === along.values.length - 1 ? " s" : "");
            const half = pen.measureText(text).width / 2;
            pen.textAlign = "center";
            pen.fillText(text, Math.min(x, this.width - half - 1), this.height - 4);
        });
    }

    limits(pen, { limits, colour }) {
        if (!limits) return;
        pen.strokeStyle = colour;
        pen.globalAlpha = 0.35;
        pen.lineWidth = 1;
        pen.setLineDash([1, 3]);
        for (const limit of limits) {
            if (limit !== null) stroke(pen, MARGIN.left, this.y(limit), this.width, this.y(limit));
        }
        pen.setLineDash([]);
        pen.globalAlpha = 1;
    }

    // A line, or where a pixel has many values a band from the lowest to the highest.
    line(pen, { series, colour, style }) {
        const [first, end] = series.range(this.window);
        const { axis } = series.run;
        pen.strokeStyle = pen.fillStyle = colour;
        pen.globalAlpha = style === "recorded" ? 1 : 0.75;
        pen.lineWidth = 1.4;
        pen.lineJoin = "round";
        pen.setLineDash(DASHES[style]);
        if (end - first === 1) {
            pen.beginPath();
            pen.arc(this.x(axis[first]), this.y(series.low[first]), 3, 0, 2 * Math.PI);
            pen.fill();
        } else {
            const [times, lows, highs] = this.gathered(series, first, end);
            pen.beginPath();
            times.forEach((x, i) => pen.lineTo(x, this.y(highs[i])));
            pen.stroke();
            if (lows.some((low, i) => this.y(low) - this.y(highs[i]) > 0.5)) {
                for (let i = times.length - 1; i >= 0; i--) pen.lineTo(times[i], this.y(lows[i]));
                pen.closePath();
                pen.globalAlpha *= 0.8;
                pen.fill();
                pen.setLineDash([]);
                pen.stroke();
            }
        }
        pen.setLineDash([]);
        pen.globalAlpha = 1;
    }

    // Places and extremes, at most two per pixel.
    gathered(series, first, end) {
        const { axis } = series.run;
        const [xs, lows, highs] = [[], [], []];
        const stride = Math.max(1, Math.floor((end - first) / (2 * Math.max(this.width, 1))));
        for (let i = first; i < end; i += stride) {
            let [low, high] = [series.low[i], series.high[i]];
            const last = Math.min(i + stride, end);
            for (let k = i + 1; k < last; k++) {
                if (series.low[k] < low) low = series.low[k];
                if (series.high[k] > high) high = series.high[k];
            }
            xs.push(this.x((axis[i] + axis[last - 1]) / 2));
            lows.push(low);
            highs.push(high);
        }
        return [xs, lows, highs];
    }

    cursor(time) {
        this.time = time;
        if (!this.window || !this.width) return;
        const pen = this.top.getContext("2d");
        pen.clearRect(0, 0, this.width, this.height);
        const x = this.x(time);
        if (x < MARGIN.left - 1 || x > this.width - MARGIN.right + 1) return;
        pen.strokeStyle = "#1d2733";
        pen.lineWidth = 1;
        stroke(pen, x, MARGIN.top - 4, x, this.height - MARGIN.bottom);
        for (const { series, colour } of this.lines) {
            const value = series.at(time);
            if (value === null) continue;
            pen.beginPath();
            pen.arc(x, this.y(value), 2.6, 0, 2 * Math.PI);
            pen.fillStyle = colour;
            pen.fill();
        }
    }
}

function stroke(pen, x1, y1, x2, y2) {
    pen.beginPath();
    pen.moveTo(x1, y1);
    pen.lineTo(x2, y2);
    pen.stroke();
}
