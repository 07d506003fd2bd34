// The drive as a recording, and the command that repeats it.

function columnNames() {
    return [
        ...drive.headers, ...(drive.hasTip ? ["tip_x [m]", "tip_y [m]", "tip_z [m]"] : []),
        ...(drive.stability ? ["stability", "static_stability"] : []),
    ];
}

// The machine as `crane.load` gets it again, with what was changed before the first step.
function loadExpression(changed) {
    const [name, options] = drive.expression;
    const all = { ...options };
    if (Object.keys(changed).length) all.changes = { ...options.changes, ...changed };
    return Object.keys(all).length ? `${name} with ${JSON.stringify(all)}` : name;
}

function command(changed) {
    const options = Object.entries(changed).map(([name, value]) => `--set ${name}=${value}`);
    return [drive.command, ...options, "--inputs", `${drive.file}.csv`, "--step", drive.interval].join(" ");
}

function recordingText({ rows, record }) {
    const notes = [drive.notes[0], `machine: ${loadExpression(record.changed)}`, ...drive.notes.slice(1)];
    if (record.changes.length) notes.push(`changes: ${JSON.stringify(record.changes.map(({ time, values }) => [time, values]))}`);
    for (const [k, result] of record.results.entries()) notes.push(`result ${k + 1}: ${JSON.stringify(result)}`);
    notes.push(`repeat: ${command(record.changed)}`, `crane samples: ${rows.length}`);
    return [...notes.map((note) => `# ${note}`), columnNames().join(","), ...rows.map((row) => Array.from(row, String).join(",")), ""].join("\n");
}

function save(taken) {
    const url = URL.createObjectURL(new Blob([recordingText(taken)], { type: "text/csv" }));
    make("a", { href: url, download: `${drive.file}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
}
