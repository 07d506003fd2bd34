// What the page draws beside the machine: goals, the load, forces; and at what expense.

// interval of frames above which fewer pixels are drawn [ms]; displays may have 50 Hz
const SMOOTH = 1000 / (isSoftware ? 57 : 40);

// A round shape has fewer corners where a processor computes them.
function drawnShape({ geometry }) {
    const { type, parameters } = geometry;
    if (!isSoftware) return geometry.clone();
    if (type === "CylinderGeometry") return new THREE.CylinderGeometry(parameters.radiusTop, parameters.radiusBottom, parameters.height, 14);
    if (type === "SphereGeometry") return new THREE.SphereGeometry(parameters.radius, 14, 9);
    return geometry.clone();
}

// The shapes of a link as one mesh with a colour at each corner, which is drawn by one call.
function merge(group) {
    group.updateMatrixWorld(true);
    const back = group.matrixWorld.clone().invert(), meshes = [];
    const arrays = { position: [], normal: [], color: [] }, index = [];
    group.traverse((item) => { if (item.isMesh && item.material.opacity === 1) meshes.push(item); });
    let first = 0;
    for (const mesh of meshes) {
        const shape = drawnShape(mesh).applyMatrix4(back.clone().multiply(mesh.matrixWorld));
        if (!shape.attributes.normal) shape.computeVertexNormals();
        const { r, g, b } = mesh.material.color, count = shape.attributes.position.count;
        for (const name of ["position", "normal"]) arrays[name].push(shape.attributes[name].array);
        arrays.color.push(Float32Array.from({ length: 3 * count }, (_, i) => [r, g, b][i % 3]));
        const corners = shape.index ? shape.index.array : Array.from({ length: count }, (_, i) => i);
        for (const corner of corners) index.push(first + corner);
        first += count;
        mesh.parent.remove(mesh);
    }
    if (!meshes.length) return;
    const merged = new THREE.BufferGeometry();
    for (const [name, parts] of Object.entries(arrays)) {
        const all = new Float32Array(parts.reduce((sum, part) => sum + part.length, 0));
        parts.reduce((start, part) => { all.set(part, start); return start + part.length; }, 0);
        merged.setAttribute(name, new THREE.BufferAttribute(all, 3));
    }
    merged.setIndex(index);
    const mesh = new THREE.Mesh(merged, new (isSoftware ? THREE.MeshLambertMaterial : THREE.MeshPhongMaterial)({ vertexColors: true, side: isSoftware ? THREE.FrontSide : THREE.DoubleSide }));
    mesh.castShadow = !isSoftware;
    group.add(mesh);
}

class DriveSpace extends Space {
    constructor(data) {
        super(data);
        this.marks = new THREE.Group();
        viewer.scene.add(this.marks);
        this.load = this.ball(1, 0x8a6a3b, 1);
        this.marks.add(this.load);
        this.arrows = drive.loads.map(() => this.arrow());
        this.most = Math.min(window.devicePixelRatio, isSoftware ? 1 : 2);
        this.ratio = isSoftware ? 0.7 * this.most : this.most;
        viewer.renderer.setPixelRatio(this.ratio);
        [this.interval, this.last, this.checked, this.goal] = [16, 0, 0, null];
        for (const group of Object.values(this.groups)) merge(group);
        if (isSoftware) this.dim();
        this.paint();
        window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.paint());
    }

    // Two lights in place of six, where a processor computes them.
    dim() {
        for (const name of ["PointLightNegativeX", "PointLightPositiveX"]) viewer.scene_tree.find(["Lights", name]).object.visible = false;
        viewer.scene_tree.find(["Lights", "AmbientLight", "<object>"]).object.intensity = 0.6;
        viewer.scene.traverse((item) => { if (item.material && item.material.type === "ShadowMaterial") item.visible = false; });
    }

    paint() {
        const isDark = window.matchMedia("(prefers-color-scheme: dark)").matches;
        viewer.set_property(["Background"], "top_color", isDark ? [0.11, 0.14, 0.18] : [0.80, 0.87, 0.93]);
        viewer.set_property(["Background"], "bottom_color", isDark ? [0.17, 0.18, 0.19] : [0.97, 0.97, 0.95]);
        viewer.scene.traverse((item) => { if (item.isLineSegments) item.material.color.setHex(isDark ? 0x3d4650 : 0xb4bac0); });
    }

    // The machine is above the sticks where there is little room beside them.
    free() {
        const narrow = element("pane").clientWidth < 600;
        const [above, below] = narrow ? [20, 0.7 * element("sticks").clientHeight] : [0, 0];
        return super.free().map(([left, top, right, bottom]) => [left, top + above, right, bottom - below]);
    }

    ball(radius, color, opacity) {
        return new THREE.Mesh(new THREE.SphereGeometry(radius, 20, 12), new THREE.MeshLambertMaterial({ color, opacity, transparent: opacity < 1 }));
    }

    arrow() {
        const one = new THREE.ArrowHelper(new THREE.Vector3(0, 0, 1), new THREE.Vector3(), 1, 0xcf4520);
        this.marks.add(one);
        return one;
    }

    // Points of a goal as balls, paths as lines.
    showGoal({ index, next, isDone }) {
        const key = `${index} ${next} ${isDone}`;
        if (key === this.goal) return;
        this.goal = key;
        if (this.course) this.marks.remove(this.course);
        this.course = new THREE.Group();
        const goal = drive.goals[index];
        if (goal) {
            const line = new THREE.BufferGeometry().setFromPoints(goal.points.map((p) => new THREE.Vector3(...p)));
            this.course.add(new THREE.Line(line, new THREE.LineBasicMaterial({ color: 0x2f8f4e })));
            goal.points.forEach((point, i) => {
                if (goal.path && i % 8 && i !== next && i !== goal.points.length - 1) return;
                const isNext = i === next && !isDone;
                const ball = this.ball(goal.radius * (isNext || !goal.path ? 1 : 0.3), i < next ? 0x9aa5b1 : isNext ? 0xf0a020 : 0x2f8f4e, i < next ? 0.25 : 0.5);
                ball.position.set(...point);
                this.course.add(ball);
            });
        }
        this.marks.add(this.course);
    }

    show(state) {
        if (!state.q.every(Number.isFinite)) return; // after a step that failed
        const poses = this.tree.poses(state.q);
        this.place(this.groups, poses);
        this.showGoal(state.goal);
        const from = drive.columns.length;
        const mass = drive.payload ? drive.payload.masses[state.conditions.payload] : 0;
        this.load.visible = mass > 0 && drive.hasTip;
        if (this.load.visible) {
            this.load.position.set(...state.row.slice(from, from + 3));
            this.load.scale.setScalar(Math.cbrt(3 * mass / (4 * Math.PI * 1500)));
        }
        drive.loads.forEach(({ frame, column, }, i) => {
            const force = new THREE.Vector3(...state.row.slice(column, column + 3));
            const size = force.length();
            this.arrows[i].visible = size > 1;
            if (size <= 1) return;
            this.longest = Math.max(this.longest || 0, size);
            this.arrows[i].position.fromArray(this.tree.pose(poses, frame), 12);
            this.arrows[i].setDirection(force.normalize());
            this.arrows[i].setLength(0.35 * this.radius * (0.15 + 0.85 * size / this.longest), 0.06 * this.radius, 0.03 * this.radius);
        });
    }

    // Draw; where frames take long, with fewer pixels, and never again with as many as took long.
    draw(now) {
        const passed = now - this.last;
        this.last = now;
        if (!viewer.needs_render) return;
        if (passed < 500) this.interval += 0.1 * (passed - this.interval);
        if (now - this.checked > 700) {
            this.checked = now;
            const isSlow = this.interval > SMOOTH;
            if (isSlow) this.most = Math.max(0.6, 0.95 * this.ratio);
            const wished = isSlow ? Math.max(0.6, 0.85 * this.ratio) : Math.min(this.most, 1.05 * this.ratio);
            if (Math.abs(wished - this.ratio) > 0.02) {
                this.ratio = wished;
                viewer.renderer.setPixelRatio(wished); // which clears the canvas
            }
        }
        viewer.render();
    }
}
