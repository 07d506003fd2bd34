// Everything together: one posture per instant, shown in space, in plots and in numbers.

const runs = page.runs.map((run) => ({
    label: run.label || "",
    motion: new Motion(run.motion, run.shift),
    axis: run.axis ? doubles(run.axis.time).map((t) => t + (run.shift || 0)) : null,
    rows: run.axis && run.axis.rows ? integers(run.axis.rows) : null,
    shift: run.shift || 0,
}));
const space = viewer && new Space(page);
const marks = viewer && new Marks(page, space, runs[0].motion);
const timeline = new Timeline(runs[0].motion.time);
const ghost = viewer && runs.length > 1 ? space.ghost() : null;
const ghostGroups = ghost && space.find(ghost);
const switches = { ghost: true };
let following = false;

function showPosture({ time }) {
    const poses = space.tree.poses(runs[0].motion.at(time));
    space.place(space.groups, poses);
    marks.update(time, poses);
    if (ghost) {
        const { motion } = runs[1];
        ghost.visible = switches.ghost && time >= motion.start - 1e-9 && time <= motion.end + 1e-9;
        if (ghost.visible) space.place(ghostGroups, space.tree.poses(motion.at(time)));
    }
    if (following) space.follow(space.tree.pose(poses, page.tip).slice(12, 15));
}

function setFollowing(on) {
    following = on;
    space.follow(null);
    if (on) space.approach(marks.tipAt(page.tip, runs[0].motion.at(timeline.time)));
    const button = element("follow");
    if (button) button.setAttribute("aria-pressed", on);
}

function look(name) {
    setFollowing(false);
    space.look(name);
}

function showViews() {
    for (const name of Object.keys(page.views)) {
        element("views").append(make("button", { textContent: name, onclick: () => look(name) }));
    }
    if (!page.tip || runs[0].motion.time.length === 1) return;
    const follow = make("button", { id: "follow", textContent: "follow tip", onclick: () => setFollowing(!following) });
    element("views").append(follow);
    follow.setAttribute("aria-pressed", false);
}

// A button per layer of marks, with its colours as a legend.
function addSwitch(name, title, colours, shown, change) {
    const dots = colours.map((colour) => {
        const dot = make("span", { className: "dot" });
        dot.style.background = colour;
        return dot;
    });
    const button = make("button", { title: `show or hide: ${title}` }, ...dots, title);
    button.dataset.layer = name;
    const set = (on) => {
        change(on);
        button.setAttribute("aria-pressed", on);
        viewer.set_dirty();
    };
    button.onclick = () => set(button.getAttribute("aria-pressed") !== "true");
    set(shown);
    element("layers").append(button);
}
function showLayers() {
    for (const [name, { title, colours, object }] of Object.entries(marks.layers)) {
        addSwitch(name, title, colours, true, (on) => { object.visible = on; });
    }
    if (!ghost) return;
    addSwitch("ghost", "ghost", ["#8fb3ea"], true, (on) => {
        switches.ghost = on;
        showPosture(timeline);
    });
}

function showSummary({ facts, forces, limits }, differences) {
    const row = (cells, tag = "td") => make("tr", {}, ...cells.map((text, i) => make(i ? tag : "th", { textContent: text })));
    element("facts").append(make("table", {}, ...facts.map((cells) => row(cells))));
    if (forces.length) {
        const head = row(["", "range", "peak", "RMS"], "th");
        element("facts").append(make("table", {}, head, ...forces.map((cells) => row(cells))));
    }
    if (differences.length) {
        const head = row(["second run", "differs by", "at"], "th");
        element("facts").append(make("table", {}, head, ...differences.map((cells) => row(cells))));
    }
    for (const text of limits) element("facts").append(make("p", { textContent: text }));
}

element("machine").textContent = page.machine;
element("task").textContent = page.task;
if (runs.length > 1) {
    const { label, shift } = runs[1];
    element("over").textContent = `over: ${label || "second run"}${shift ? ` (its clock moved by ${spoken(shift)} s)` : ""}`;
    element("over").hidden = false;
}
showSummary(page.summary, page.differences);
if (!page.groups.length) element("summary").querySelector("summary").textContent = "Machine";

// On a small page the numbers stand below the plots, else in the corner of the picture.
const small = window.matchMedia("(max-width: 1100px), (max-height: 560px)");
function arrange() {
    const below = small.matches && page.groups.length > 0;
    element(below ? "side" : "space").append(element("summary"));
    if (small.matches && !below) element("summary").open = false;
    if (viewer) viewer.set_3d_pane_size();
}
if (viewer) {
    showViews();
    showLayers();
    timeline.listen(showPosture);
} else {
    element("pane").append(make("p", { textContent: "This browser draws nothing in space (WebGL is off)." }));
}
small.addEventListener("change", arrange);
arrange();
document.body.classList.toggle("still", page.groups.length === 0);
const channels = page.groups.length ? new Channels(page, runs, timeline) : null;
if (page.groups.length) showPlayer(timeline);
timeline.tell();

// For scripts: where everything is, and to move it.
window.crane = {
    timeline, space, marks, channels, viewer, look,
    seek: (time) => { timeline.pause(); timeline.seek(time); },
    get time() { return timeline.time; },
    // Pose of a link as it is drawn, or would be: 16 numbers, column by column, z up [m].
    pose(link) {
        if (!(link in space.groups)) {
            const poses = space.tree.poses(runs[0].motion.at(timeline.time));
            return Array.from(space.tree.pose(poses, space.tree.links[link]));
        }
        viewer.scene.updateMatrixWorld(true);
        const back = viewer.scene.matrixWorld.clone().invert();
        return back.multiply(space.groups[link].matrixWorld).toArray();
    },
};
