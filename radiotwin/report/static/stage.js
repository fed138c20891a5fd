"use strict";
// The 3D picture: the city and a slice in WebGL (three.js), and over it a plain canvas with everything
// that must stay readable at any distance: devices, paths, labels. Coordinates are in metres, x east,
// y north, z up.

// Shaders of a few lines: those of three.js's own materials take a second each to compile without a
// graphics card.
const POSITION = `precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix;
attribute vec3 position;`;
const COLOURED = {
  vertexShader: `${POSITION}
    attribute vec3 color;
    uniform float size;  // of dots, in pixels
    varying vec3 shown;
    void main() {
      shown = color;
      gl_PointSize = size;
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    }`,
  fragmentShader: `precision mediump float;
    uniform float lightness;  // of the city and its ground
    varying vec3 shown;
    void main() { gl_FragColor = vec4(lightness * shown, 1.0); }`};
const CELLS = {
  vertexShader: `${POSITION}
    attribute vec2 uv;
    varying vec2 cell;
    void main() {
      cell = uv;
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    }`,
  fragmentShader: `precision highp float;
    uniform sampler2D cells;
    varying vec2 cell;
    void main() {
      vec4 colour = texture2D(cells, cell);
      gl_FragColor = vec4(colour.rgb, 0.72 * colour.a);
    }`};
const GROUND = [0.945, 0.953, 0.957], STREET = 0.66;
const DARK = window.matchMedia("(prefers-color-scheme: dark)");
const DOT_PIXELS = 6;
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;

// Drawn pixels for each pixel of the page, along a side. Two smooth the edges where there is a graphics
// card. Without one, WebGL's own antialiasing would take four times as long for each triangle.
function sharpness(gl) {
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const by = gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  return SOFTWARE.test(by) ? window.devicePixelRatio : Math.max(window.devicePixelRatio, 2);
}

class Stage {
  constructor(container, data) {
    this.container = container;
    this.data = data;
    this.renderer = new THREE.WebGLRenderer();
    this.renderer.setPixelRatio(sharpness(this.renderer.context));
    this.overlay = document.createElement("canvas");
    container.append(this.renderer.domElement, this.overlay);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(35, 1, 1, 1e6);
    this.camera.up.set(0, 0, 1);
    const coloured = () => new THREE.RawShaderMaterial({...COLOURED, side: THREE.DoubleSide, uniforms: {
      size: {value: DOT_PIXELS * this.renderer.getPixelRatio()}, lightness: {value: 1}}});
    this.coloured = coloured();
    this.city = data.city ? this.addCity(data.city) : new THREE.Object3D();
    this.addGround();
    if (data.streets) this.addStreets(data.streets);
    this.slice = this.addSlice();
    this.dots = new THREE.Points(new THREE.BufferGeometry(), coloured());
    this.dots.frustumCulled = this.dots.visible = false;
    this.scene.add(this.dots);
    this.drawings = [];  // functions of the overlay's context, called after each frame
    this.fit();
    this.look("oblique");
    this.listen();
    this.paint(DARK.matches);
    DARK.addEventListener("change", () => { this.paint(DARK.matches); this.redraw(); });
    new ResizeObserver(() => { if (this.fit()) this.draw(); }).observe(container);
  }

  paint(dark) {
    this.ink = dark ? "#e2e7eb" : "#111";
    this.found = dark ? "#ff9a9c" : "#c1121f";
    this.cause = dark ? "#e7a6ea" : "#8e2a93";
    this.halo = dark ? "rgba(20, 25, 30, 0.85)" : "rgba(255, 255, 255, 0.85)";
    this.renderer.setClearColor(dark ? 0x14191e : 0xffffff);
    this.coloured.uniforms.lightness.value = dark ? 0.4 : 1;
  }

  addCity({x, y, z, i, j, k}) {
    // One constant colour for each face: brighter the higher it is and the more it faces the light.
    const light = new THREE.Vector3(-0.35, -0.62, 0.7).normalize(), top = Math.max(this.data.top_m, 1);
    const position = new Float32Array(9 * i.length), colour = new Float32Array(9 * i.length);
    const corners = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()], across = new THREE.Vector3();
    for (let face = 0; face < i.length; face++) {
      [i, j, k].forEach((index, n) => {
        const from = index[face];
        corners[n].set(x[from], y[from], z[from]).toArray(position, 9 * face + 3 * n);
      });
      const normal = corners[1].sub(corners[0]).cross(across.subVectors(corners[2], corners[0])).normalize();
      const lit = 0.5 + 0.3 * Math.abs(normal.dot(light)), high = Math.max(z[i[face]], z[j[face]], z[k[face]]) / top;
      for (let n = 0; n < 3; n++)
        colour.set([lit, lit + 0.012, lit + 0.03].map(part => Math.min(part + 0.15 * high, 1)), 9 * face + 3 * n);
    }
    const geometry = new THREE.BufferGeometry();
    geometry.addAttribute("position", new THREE.BufferAttribute(position, 3));
    geometry.addAttribute("color", new THREE.BufferAttribute(colour, 3));
    const mesh = new THREE.Mesh(geometry, this.coloured);
    this.scene.add(mesh);
    return mesh;
  }

  addGround() {
    const [x0, x1, y0, y1] = this.data.bounds;
    const plane = new THREE.PlaneBufferGeometry(x1 - x0, y1 - y0);
    plane.addAttribute("color", new THREE.BufferAttribute(new Float32Array([GROUND, GROUND, GROUND, GROUND].flat()), 3));
    const ground = new THREE.Mesh(plane, this.coloured);
    ground.position.set((x0 + x1) / 2, (y0 + y1) / 2, -0.3);
    this.scene.add(ground);
  }

  addStreets(ends) {
    const geometry = new THREE.BufferGeometry(), count = ends.length / 3;
    geometry.addAttribute("position", new THREE.BufferAttribute(ends, 3));
    geometry.addAttribute("color", new THREE.BufferAttribute(new Float32Array(3 * count).fill(STREET), 3));
    this.scene.add(new THREE.LineSegments(geometry, this.coloured));
  }

  addSlice() {
    const slice = new THREE.Mesh(new THREE.PlaneBufferGeometry(1, 1), new THREE.RawShaderMaterial({
      ...CELLS, uniforms: {cells: {value: null}}, transparent: true, side: THREE.DoubleSide, depthWrite: false}));
    slice.visible = false;
    this.scene.add(slice);
    return slice;
  }

  // A slice of coloured cells: RGBA bytes (ny, nx), south first, and the centre of the first cell [m].
  showSlice(rgba, nx, ny, west, south, step, z) {
    const {cells} = this.slice.material.uniforms;
    cells.value?.dispose();
    cells.value = new THREE.DataTexture(rgba, nx, ny, THREE.RGBAFormat);  // nearest cell, not interpolated
    cells.value.needsUpdate = true;
    this.slice.scale.set(nx * step, ny * step, 1);
    this.slice.position.set(west + (nx - 1) * step / 2, south + (ny - 1) * step / 2, z);
    this.slice.visible = true;
    this.dots.visible = false;
  }

  showDots(position, colour) {
    this.dots.geometry.dispose();
    this.dots.geometry = new THREE.BufferGeometry();
    this.dots.geometry.addAttribute("position", new THREE.BufferAttribute(new Float32Array(position), 3));
    this.dots.geometry.addAttribute("color", new THREE.BufferAttribute(new Float32Array(colour), 3));
    this.dots.visible = true;
    this.slice.visible = false;
  }

  // The camera moves on a sphere around a point. Here it is as near as all of the city stays in view.
  look(from) {
    const [x0, x1, y0, y1] = this.data.bounds, top = this.data.top_m;
    const corners = [x0, x1].flatMap(x => [y0, y1].flatMap(y => [[x, y, 0], [x, y, top]]));
    this.middle = new THREE.Vector3((x0 + x1) / 2, (y0 + y1) / 2, 0.3 * top);
    [this.turn, this.lift] = from === "above" ? [-Math.PI / 2, Math.PI / 2 - 1e-3] : [-Math.PI / 2 + 0.45, 0.72];
    this.far = 3 * Math.max(x1 - x0, y1 - y0, top);
    const filled = this.width < 500 ? 0.94 : 0.86;  // of the picture; numbers stand around
    for (let n = 0; n < 8; n++) {  // each step is nearer to the answer
      this.aim();
      const pixels = corners.map(at => this.pixel(...at));
      const [[left, right], [up, down]] = [0, 1].map(axis => pixels.map(at => at[axis])).map(
        along => [Math.min(...along), Math.max(...along)]);
      this.pan((this.width - left - right) / 2, (this.height - up - down) / 2);
      this.far *= Math.max((right - left) / this.width, (down - up) / this.height) / filled;
    }
    this.redraw();
  }

  listen() {
    const pointers = new Map();
    this.container.addEventListener("pointerdown", event => {
      this.container.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
      this.pressed = event;
    });
    this.container.addEventListener("click", event => {  // no drag
      if (Math.hypot(event.clientX - this.pressed?.clientX, event.clientY - this.pressed?.clientY) < 5) this.pick?.(event);
    });
    for (const end of ["pointerup", "pointercancel"])
      this.container.addEventListener(end, event => pointers.delete(event.pointerId));
    this.container.addEventListener("pointermove", event => {
      const before = pointers.get(event.pointerId);
      if (!before) { this.hover?.(event); return; }
      const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
      const other = [...pointers.values()].find(pointer => pointer.pointerId !== event.pointerId);
      if (other) {  // two fingers: nearer or farther
        const apart = pointer => Math.hypot(pointer.clientX - other.clientX, pointer.clientY - other.clientY);
        this.zoom(apart(before) / Math.max(apart(event), 1));
      } else if (event.buttons & 2 || event.shiftKey) this.pan(dx, dy);
      else this.rotate(dx, dy);
      pointers.set(event.pointerId, event);
      this.redraw();
    });
    this.container.addEventListener("contextmenu", event => event.preventDefault());
    this.container.addEventListener("wheel", event => {
      if (!event.ctrlKey && !event.metaKey) return;  // the page scrolls
      event.preventDefault();
      this.zoom(Math.exp(0.001 * event.deltaY));
      this.redraw();
    }, {passive: false});
    this.container.addEventListener("keydown", event => this.press(event));
    window.addEventListener("beforeprint", () => this.print());
  }

  press(event) {
    const [dx, dy] = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key] ?? [0, 0];
    if (dx || dy) event.shiftKey ? this.pan(-30 * dx, -30 * dy) : this.rotate(15 * dx, 15 * dy);
    else if (event.key === "+" || event.key === "=") this.zoom(0.9);
    else if (event.key === "-") this.zoom(1.1);
    else return;
    event.preventDefault();
    this.redraw();
  }

  rotate(dx, dy) {
    this.turn -= 0.006 * dx;
    this.lift = Math.min(Math.max(this.lift + 0.006 * dy, 0.05), Math.PI / 2 - 1e-3);
  }

  // What is on the canvases as one picture: browsers print WebGL as nothing.
  print() {
    this.paint(false);
    this.draw();
    const both = document.createElement("canvas"), [glass] = this.container.getElementsByTagName("canvas");
    Object.assign(both, {width: this.overlay.width, height: this.overlay.height});
    const context = both.getContext("2d");
    for (const each of [glass, this.overlay]) context.drawImage(each, 0, 0, both.width, both.height);
    this.printed ??= this.container.appendChild(Object.assign(new Image(), {className: "printed", alt: "The city as it is shown"}));
    this.printed.src = both.toDataURL();
    this.paint(DARK.matches);
    this.redraw();
  }

  zoom(factor) { this.far = Math.min(Math.max(this.far * factor, 5), 1e5); }

  pan(dx, dy) {
    const metres = 2 * this.far * Math.tan(Math.PI * this.camera.fov / 360) / this.container.clientHeight;
    const [sin, cos] = [Math.sin(this.turn), Math.cos(this.turn)];
    this.middle.x += metres * (sin * dx - cos * dy);
    this.middle.y += metres * (-cos * dx - sin * dy);
  }

  fit() {  // resizes both canvases; returns whether the size has changed
    const {clientWidth: width, clientHeight: height} = this.container;
    if (width === this.width && height === this.height) return false;
    Object.assign(this, {width, height});
    this.renderer.setSize(width, height);
    Object.assign(this.overlay, {width: width * window.devicePixelRatio, height: height * window.devicePixelRatio});
    this.camera.aspect = width / Math.max(height, 1);
    return true;
  }

  redraw() {  // once a frame, however much has changed
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  aim() {
    const {camera, far} = this;
    const across = Math.cos(this.lift);
    camera.position.set(across * Math.cos(this.turn), across * Math.sin(this.turn), Math.sin(this.lift));
    camera.position.multiplyScalar(far).add(this.middle);
    Object.assign(camera, {near: far / 200, far: 10 * far + 1e4});
    camera.lookAt(this.middle);
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }

  draw() {
    this.aim();
    this.taken = [];  // boxes in pixels that labels have, and marks
    this.renderer.render(this.scene, this.camera);
    const context = this.overlay.getContext("2d");
    context.setTransform(window.devicePixelRatio, 0, 0, window.devicePixelRatio, 0, 0);
    context.clearRect(0, 0, this.container.clientWidth, this.container.clientHeight);
    this.drawings.forEach(drawing => drawing(context));
  }

  // Pixels of a point; null behind the camera.
  pixel(x, y, z) {
    const at = new THREE.Vector3(x, y, z).project(this.camera);
    if (at.z > 1) return null;
    return [(at.x + 1) / 2 * this.container.clientWidth, (1 - at.y) / 2 * this.container.clientHeight];
  }

  // (x, y) of the height z [m] under a pointer event; null where the ray does not meet it.
  under(event, z) {
    const box = this.container.getBoundingClientRect(), ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2(2 * (event.clientX - box.left) / box.width - 1,
                                        1 - 2 * (event.clientY - box.top) / box.height), this.camera);
    return ray.ray.intersectPlane(new THREE.Plane(new THREE.Vector3(0, 0, 1), -z), new THREE.Vector3());
  }
}
