// One clock for everything: who listens is told the time and the frame nearest to it.

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 30, 60];

class Timeline {
    constructor(times) {
        this.times = times;
        this.start = times[0];
        this.end = times[times.length - 1];
        this.origin = Math.abs(this.start) > 1e5 ? Math.floor(this.start) : 0; // of what is shown
        this.time = this.start;
        this.frame = 0;
        this.speed = 1;
        this.playing = false;
        this.listeners = [];
    }

    listen(listener) {
        this.listeners.push(listener);
    }

    tell() {
        this.frame = nearest(this.times, this.time);
        for (const listener of this.listeners) listener(this);
    }

    // Go to the frame nearest to a time: what stands still was recorded, not made up.
    seek(time) {
        this.go(nearest(this.times, time));
    }

    go(frame) {
        this.time = this.times[Math.min(Math.max(frame, 0), this.times.length - 1)];
        this.tell();
    }

    step(frames) {
        this.pause();
        this.go(this.frame + frames);
    }

    toggle() {
        if (this.playing) this.pause();
        else this.play();
    }

    play() {
        if (this.playing || this.end === this.start) return;
        if (this.time >= this.end) this.time = this.start;
        this.playing = true;
        let before = null;
        const run = (now) => {
            if (!this.playing) return;
            if (before !== null) this.time += this.speed * Math.min(now - before, 250) / 1000;
            before = now;
            if (this.time >= this.end) {
                this.time = this.end;
                this.playing = false;
            }
            this.tell();
            if (this.playing) requestAnimationFrame(run);
        };
        requestAnimationFrame(run);
        this.tell();
    }

    pause() {
        if (!this.playing) return;
        this.playing = false;
        this.seek(this.time);
    }
}

// Buttons, slider, speed, clock and keys.
function showPlayer(timeline) {
    element("player").hidden = false;
    const seek = element("seek");
    [seek.min, seek.max, seek.value] = [timeline.start, timeline.end, timeline.start];
    seek.addEventListener("input", () => timeline.seek(Number(seek.value)));
    element("play").onclick = () => timeline.toggle();
    element("first").onclick = () => timeline.seek(timeline.start);
    element("back").onclick = () => timeline.step(-1);
    element("next").onclick = () => timeline.step(1);
    const speed = element("speed");
    for (const value of SPEEDS) {
        speed.append(make("option", { value, textContent: `${value}\u00d7`, selected: value === 1 }));
    }
    speed.onchange = () => { timeline.speed = Number(speed.value); };
    const span = timeline.end - timeline.start;
    const decimals = span > 600 ? 1 : span > 1 ? 2 : 4;
    const text = (time) => (time - timeline.origin).toFixed(decimals);
    element("clock").style.minWidth = `${2 * text(timeline.end).length + 5}ch`;
    timeline.listen(() => {
        seek.value = timeline.time;
        element("clock").textContent = `${text(timeline.time)} / ${text(timeline.end)} s`;
        document.body.classList.toggle("playing", timeline.playing);
        element("play").setAttribute("aria-label", timeline.playing ? "pause" : "play");
    });
    window.addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
        const large = Math.max(1, Math.round(timeline.times.length / 50));
        const keys = {
            " ": () => timeline.toggle(),
            ArrowLeft: () => timeline.step(event.shiftKey ? -large : -1),
            ArrowRight: () => timeline.step(event.shiftKey ? large : 1),
            ArrowUp: () => timeline.step(large),
            ArrowDown: () => timeline.step(-large),
            Home: () => timeline.seek(timeline.start),
            End: () => { timeline.pause(); timeline.seek(timeline.end); },
        };
        if (!(event.key in keys)) return;
        // a button that has the focus would be pressed by the space bar as well
        if (event.key === " ") document.activeElement.blur();
        event.preventDefault();
        keys[event.key]();
    }, true);
}
