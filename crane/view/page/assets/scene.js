// The machine in space: meshcat's viewer, its light and camera, and the pose of every link.

// Where a browser cannot draw in space, there is no viewer: plots and numbers remain.
const THREE = MeshCat.THREE;
const context = make("canvas").getContext("webgl");
const isSoftware = context !== null && drawsBySoftware();
const viewer = context ? new MeshCat.Viewer(element("pane"), !page.drive, page.drive && isSoftware ? plainRenderer() : undefined) : null;

function drawsBySoftware() {
    const info = context.getExtension("WEBGL_debug_renderer_info");
    return /swiftshader|llvmpipe|software|basic render/i.test(info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "");
}

// Without shadows and smooth edges, which a processor draws too slowly.
function plainRenderer() {
    const renderer = new THREE.WebGLRenderer({ antialias: false, alpha: false, powerPreference: "high-performance" });
    element("pane").appendChild(renderer.domElement);
    return renderer;
}

// The viewer's scene is turned, so that its z axis points up; the camera lives outside, y up.
const vector = ([x, y, z]) => new THREE.Vector3(x, z, -y);

class Space {
    constructor({ lower, upper, ground, views, tree }) {
        this.views = views;
        this.tree = new Tree(tree);
        const pane = element("pane");
        viewer.set_3d_pane_size = () => {
            const [width, height] = [Math.max(pane.clientWidth, 1), Math.max(pane.clientHeight, 1)];
            if (width !== this.width || height !== this.height) viewer.renderer.setSize(width, height);
            [this.width, this.height] = [width, height];
            viewer.camera.aspect = width / height;
            viewer.camera.updateProjectionMatrix();
            if (this.view && !this.touched) this.look(this.view);
            viewer.set_dirty();
        };
        viewer.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
        viewer.gui.domElement.remove();
        const commands = JSON.parse(element("page-commands").textContent);
        for (const command of commands) viewer.handle_command_bytearray(bytes(command));
        this.lower = lower;
        this.ground = ground;
        this.upper = upper;
        this.centre = vector(lower.map((low, i) => (low + upper[i]) / 2));
        this.radius = vector(upper).distanceTo(vector(lower)) / 2;
        this.machine = viewer.scene_tree.find(["meshcat", "machine"]).object;
        this.groups = this.find(this.machine);
        this.followed = null;
        this.light();
        viewer.camera.fov = 30;
        this.look("iso");
        new ResizeObserver(() => viewer.set_3d_pane_size()).observe(pane);
        element("summary").addEventListener("toggle", () => viewer.set_3d_pane_size());
        viewer.controls.addEventListener("start", () => { this.touched = true; });
    }

    // Groups of links below an object, by name; their poses are set from here alone.
    find(root) {
        const groups = {};
        for (const child of root.children) {
            if (!(child.name in this.tree.links)) continue;
            groups[child.name] = child;
            child.matrixAutoUpdate = false;
        }
        return groups;
    }

    // Put the links of a machine where a posture has them.
    place(groups, poses) {
        for (const [link, group] of Object.entries(groups)) {
            group.matrix.fromArray(this.tree.pose(poses, this.tree.links[link]));
            group.matrixWorldNeedsUpdate = true;
        }
        viewer.set_dirty();
    }

    // A second machine of glass, which moves on its own.
    ghost() {
        const root = this.machine.clone(true);
        const glass = new THREE.MeshPhongMaterial({
            color: 0x3d7bd9, transparent: true, opacity: 0.3, depthWrite: false,
            polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2, // behind what is in the same place
        });
        root.traverse((item) => {
            item.castShadow = false;
            if (item.isMesh) [item.material, item.renderOrder] = [glass, 1];
        });
        this.machine.parent.add(root);
        return root;
    }

    // Parts of the pane that nothing stands on: [left, top, right, bottom] in pixels.
    free() {
        const pane = element("pane").getBoundingClientRect();
        const views = element("views").getBoundingClientRect();
        const layers = element("layers").getBoundingClientRect();
        const top = views.height ? views.bottom - pane.top + 4 : 10;
        const bottom = layers.height ? layers.top - pane.top - 4 : pane.height - 10;
        const card = element("summary");
        if (card.parentElement !== element("space") || !card.open || !card.clientHeight) return [[10, top, pane.width - 10, bottom]];
        const { right, bottom: under } = card.getBoundingClientRect();
        const beside = [right - pane.left + 8, top, pane.width - 10, bottom];
        const below = [10, Math.max(top, under - pane.top + 8), pane.width - 10, bottom];
        return [beside, below];
    }

    // How far away the camera has to be for all corners of the machine's box to be in a part of
    // the pane.
    distance(back, [x1, y1, x2, y2]) {
        const right = new THREE.Vector3(0, 1, 0).cross(back).normalize();
        const top = back.clone().cross(right);
        const perPixel = 2 * Math.tan(viewer.camera.fov * Math.PI / 360) / element("pane").clientHeight;
        const [wide, high] = [x2 - x1, y2 - y1].map((pixels) => 0.47 * perPixel * Math.max(pixels, 40));
        let distance = 0;
        for (let i = 0; i < 8; i++) {
            const corner = vector([0, 1, 2].map((k) => (i >> k & 1 ? this.upper : this.lower)[k])).sub(this.centre);
            const needed = Math.max(Math.abs(corner.dot(right)) / wide, Math.abs(corner.dot(top)) / high);
            distance = Math.max(distance, corner.dot(back) + needed);
        }
        return distance;
    }

    // Look from a direction at the whole machine, where it appears largest.
    look(name) {
        this.view = name;
        this.touched = false;
        const [width, height] = [element("pane").clientWidth, element("pane").clientHeight];
        if (!width || !height) return;
        const back = vector(this.views[name]).normalize();
        const places = this.free().map((part) => ({ part, distance: this.distance(back, part) }));
        const { part: [x1, y1, x2, y2], distance } = places.reduce((a, b) => (b.distance < a.distance ? b : a));
        viewer.camera.setViewOffset(width, height, (width - x1 - x2) / 2, (height - y1 - y2) / 2, width, height);
        viewer.camera.near = distance / 100;
        viewer.camera.far = distance * 100;
        viewer.camera.position.copy(back.multiplyScalar(distance).add(this.centre));
        viewer.controls.target.copy(this.centre);
        viewer.controls.update();
        viewer.set_dirty();
    }

    // Keep a moving point where it is in the picture; null lets it go.
    follow(point) {
        const now = point && vector(point);
        if (now && this.followed) {
            const step = now.clone().sub(this.followed);
            viewer.camera.position.add(step);
            viewer.controls.target.add(step);
            viewer.controls.update();
        }
        this.followed = now;
    }

    // Look at a point from nearer, and then follow it.
    approach(point) {
        const target = vector(point);
        const back = viewer.camera.position.clone().sub(viewer.controls.target).normalize();
        viewer.controls.target.copy(target);
        viewer.camera.position.copy(back.multiplyScalar(2.6 * this.radius).add(target));
        viewer.controls.update();
        this.touched = true;
        this.followed = target;
        viewer.set_dirty();
    }

    // One sun with shadows on the ground; the viewer's own lights only fill, and do not fade.
    light() {
        const fill = { PointLightNegativeX: 0.15, PointLightPositiveX: 0.15, FillLight: 0.15, AmbientLight: 0.5 };
        for (const [name, intensity] of Object.entries(fill)) {
            const light = viewer.scene_tree.find(["Lights", name, "<object>"]).object;
            light.intensity = intensity;
            if (light.distance) {
                light.distance = 0;
                light.position.multiplyScalar(4 * this.radius);
            }
        }
        viewer.scene.traverse((item) => { item.castShadow = item.isMesh === true; });
        const [r, centre] = [this.radius, this.centre];
        const sun = new THREE.DirectionalLight(0xffffff, 0.5);
        sun.position.copy(centre).add(vector([0.7, -1, 2]).multiplyScalar(r));
        sun.target.position.copy(centre);
        sun.castShadow = true;
        sun.shadow.mapSize.set(1024, 1024);
        sun.shadow.normalBias = r / 400;
        Object.assign(sun.shadow.camera, { left: -r, right: r, bottom: -r, top: r, near: r / 10, far: 5 * r });
        const ground = new THREE.Mesh(new THREE.PlaneGeometry(40 * r, 40 * r), new THREE.ShadowMaterial({ opacity: 0.18 }));
        ground.rotateX(-Math.PI / 2);
        ground.position.copy(centre).setY(this.ground);
        ground.receiveShadow = true;
        const group = new THREE.Group();
        group.rotateX(Math.PI / 2);
        group.add(sun, sun.target, ground);
        viewer.scene.add(group);
    }
}
