// The page: the server's answers, saving, and what happens after a change.

let findings = [], masses = {}, moved = null; // moved: the linkage as the server has it
const pending = { busy: false, next: new Map() };

async function post(action, values) {
    const answer = await fetch(action, { method: "POST", body: JSON.stringify(values) });
    return answer.json();
}

// Ask for something; of several questions of a kind only the last is sent, one after the other.
async function ask(action, values) {
    pending.next.set(action, values);
    if (pending.busy) return;
    pending.busy = true;
    while (pending.next.size) {
        const [[name, question]] = pending.next;
        pending.next.delete(name);
        try {
            take(name, await post(name, question), question);
        } catch (error) {
            tell(error instanceof TypeError ? `no answer${name === "save" ? ", not saved" : ""}: crane draw has ended, start it again` : String(error), true);
        }
    }
    pending.busy = false;
}

function take(action, answer, question) {
    if (answer.error) tell(answer.error, true);
    if (action === "save") {
        if (!answer.error) noteWritten(answer.findings, question);
    } else if (action === "check") {
        [findings, masses, moved] = [answer.findings || [], answer.masses || {}, answer.points ? answer : null];
        changedPanel();
    } else if (!answer.error) {
        moved = answer;
    }
    showMotion();
    showState();
    render();
}

const check = () => ask("check", { model: content() });
let checkSoon = 0, panelSoon = 0;

function changedSoon() { // while a point is dragged
    moved = null;
    window.clearTimeout(checkSoon);
    checkSoon = window.setTimeout(check, 60);
}

function changedPanel() {
    window.clearTimeout(panelSoon);
    panelSoon = window.setTimeout(renderPanel);
}

function changed() {
    if (selection.section && !drawing()[selection.section][selection.name]) selection = {};
    chain.points = chain.points.filter((point) => Array.isArray(point) || drawing().points[point]);
    moved = null;
    element("name").value = model.name;
    element("name").size = Math.max(6, model.name.length);
    render();
    changedPanel();
    showState();
    check();
}

const save = () => ask("save", { model: content(), renames });

function noteWritten(problems, question) {
    noteSaved();
    history.saved = JSON.stringify(question.model);
    tell(problems.length ? `saved; ${problems[0]}` : `saved to ${page.file}`, problems.some((text) => text.includes(" error: ")));
}

function tell(text, isFaulty = false) {
    element("hint").textContent = text;
    element("hint").className = isFaulty ? "fault" : "";
}

const isSaved = () => JSON.stringify(content()) === history.saved;

function showState() {
    const errors = findings.filter(({ isError }) => isError).length;
    const size = moved ? `${moved.joints.length} driven` : isBegun() && errors ? `${errors} to correct` : "";
    element("state").textContent = size;
    element("state").classList.toggle("fault", !moved && isBegun() && errors > 0);
    element("file").textContent = page.file + (isSaved() ? "" : " · not saved");
    element("undo").disabled = !history.done.length;
    element("redo").disabled = !history.undone.length;
}

for (const [name, { text, key, hint, isOfPicture }] of Object.entries(TOOLS)) {
    if (isOfPicture) continue;
    const one = button(text, () => setTool(name), { id: `tool-${name}`, title: `${hint} (${key.toUpperCase()})` });
    one.append(make("kbd", { textContent: key.toUpperCase() }));
    element("tools").append(one);
}
element("name").onchange = () => change(() => { model.name = element("name").value.trim() || model.name; });
element("undo").onclick = () => travel(history.done, history.undone);
element("redo").onclick = () => travel(history.undone, history.done);
element("fit").onclick = fit;
element("save").onclick = save;
element("done").onclick = finishBody;
element("cancel").onclick = () => { endChain(); render(); };
window.addEventListener("beforeunload", (event) => { if (!isSaved()) event.preventDefault(); });
new ResizeObserver(render).observe(canvas);

function begin() {
    noteSaved();
    if (!page.model.drawing || !page.hasPicture) history.saved = page.model.drawing ? history.saved : "";
    setTool("select");
    changed();
    fit();
}

// A picture without a width is new: it gets that of the drawing, until it is scaled.
function placePicture() {
    const places = Object.keys(drawing().points).map(place);
    if (drawing().picture.width) return;
    const wide = places.length ? Math.max(...places.map(([x]) => x)) - Math.min(...places.map(([x]) => x)) : 0;
    Object.assign(drawing().picture, { width: Number((1.4 * wide || 10).toPrecision(3)), corner: [places.length ? Number((Math.min(...places.map(([x]) => x)) - 0.2 * wide).toFixed(3)) : 0, 0] });
    picture.movesPoints = !places.length;
}

if (page.hasPicture) {
    const image = new Image();
    image.onload = () => {
        picture.image = image;
        placePicture();
        begin();
        if (!places()) setTool("scale");
    };
    image.onerror = () => {
        begin();
        tell("this browser cannot show the picture, save it as PNG", true);
    };
    image.src = "picture";
} else {
    begin();
}

function places() { return Object.keys(drawing().points).length; }

// For scripts.
window.crane = { get model() { return content(); }, get findings() { return findings; }, get moved() { return moved; }, get idle() { return !pending.busy; }, pixels, position, place };
