// The three-dimensional view: clay, tools, goal, floor, camera. It draws what it is told; what is shown is the player's business.

const GOAL_COLOUR = 0x3f8f6b;
const TOOL_COLOUR = 0x456b9e, TOOL_OPACITY = 0.72;
const OTHER_COLOUR = 0xd07a2d, OTHER_OPACITY = 0.5;
const BACKGROUND = 0xf8f7f4;
const LIGHT = [-0.55, 0.75, 0.35];
const AZIMUTH = 28, ELEVATION = 34;
const FIELD_OF_VIEW = 32;
const VIEWS = { default: [AZIMUTH, ELEVATION], front: [0, 4], side: [90, 4], top: [0, 89.5] };

/** Whether WebGL computes on the processor: then pixels are dear. */
function drawnBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

class View {
  constructor(canvas, content) {
    const { WebGLRenderer, Scene, PerspectiveCamera, OrbitControls, Vector3 } = libraries;
    this.content = content;
    const software = drawnBySoftware();
    this.renderer = new WebGLRenderer({ canvas, antialias: !software });
    this.renderer.setClearColor(BACKGROUND);
    this.renderer.setPixelRatio(software ? 1 : Math.min(window.devicePixelRatio, 2));
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 20);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => { this.stale = true; });
    this.light = new Vector3(...LIGHT).normalize();
    this.clay = new Clay(content);
    this.scene.add(this.clay.surface, this.clay.particles, this.makeFloor());
    this.tools = [];
    this.otherTools = [];
    this.goal = null;
    this.stale = true;
    this.look(...VIEWS.default);
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
  }

  /** Middle and radius of what there is to see. */
  extent() {
    const { low, high } = this.content.bounds;
    const middle = low.map((value, axis) => 0.5 * (value + high[axis]));
    return { middle, radius: 0.5 * Math.hypot(...low.map((value, axis) => high[axis] - value)) };
  }

  look(azimuth, elevation) {
    const { middle, radius } = this.extent();
    const [a, e] = [azimuth, elevation].map((angle) => (angle * Math.PI) / 180);
    const distance = (1.1 * radius + 0.05) / Math.sin((0.5 * FIELD_OF_VIEW * Math.PI) / 180);
    const towards = [Math.cos(e) * Math.sin(a), Math.sin(e), Math.cos(e) * Math.cos(a)];
    this.controls.target.set(...middle);
    this.camera.position.set(...middle.map((value, axis) => value + distance * towards[axis]));
    this.controls.update();
    this.stale = true;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    const pixels = (height * this.renderer.getPixelRatio()) / (2 * Math.tan((0.5 * FIELD_OF_VIEW * Math.PI) / 180));
    this.clay.uniforms.pixels.value = pixels;
    this.stale = true;
  }

  makeFloor() {
    const { BufferAttribute, BufferGeometry, Group, LineBasicMaterial, LineLoop, Mesh, MeshBasicMaterial, PlaneGeometry } = libraries;
    const { low, high } = this.content.bounds;
    const margin = 0.08, y = this.content.ground - 0.004;
    const [x0, x1, z0, z1] = [low[0] - margin, high[0] + margin, low[2] - margin, high[2] + margin];
    const plane = new Mesh(new PlaneGeometry(x1 - x0, z1 - z0), new MeshBasicMaterial({ color: 0xf1f0ec }));
    plane.rotation.x = -0.5 * Math.PI;
    plane.position.set(0.5 * (x0 + x1), y, 0.5 * (z0 + z1));
    const corners = new BufferGeometry();
    corners.setAttribute("position", new BufferAttribute(new Float32Array([x0, y, z0, x1, y, z0, x1, y, z1, x0, y, z1]), 3));
    const group = new Group();
    group.add(plane, new LineLoop(corners, new LineBasicMaterial({ color: 0xb9b6ad })));
    return group;
  }

  async loadTools() {
    const { tools } = this.content;
    const surfaces = await Promise.all(tools.map((tool) => loadFloats(tool.array)));
    const triangles = await Promise.all(tools.map((tool) => (tool.triangles ? loadIndices(tool.triangles) : null)));
    const solid = (look) => solidMaterial(...look, this.clay.uniforms);
    const make = (...look) => tools.map((tool, number) => new Tool(tool, surfaces[number], triangles[number], solid(look)));
    this.tools = make(TOOL_COLOUR, TOOL_OPACITY);
    this.otherTools = make(OTHER_COLOUR, OTHER_OPACITY);
    for (const tool of [...this.tools, ...this.otherTools]) this.scene.add(tool.mesh);
    for (const tool of this.otherTools) tool.mesh.visible = false;
    this.stale = true;
  }

  async loadGoal() {
    const { BufferAttribute, BufferGeometry, Mesh } = libraries;
    const { vertices, triangles } = this.content.goal;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(await loadShorts(vertices), (value) => value / QUANTA), 3));
    geometry.setIndex(new BufferAttribute(await loadIndices(triangles), 1));
    geometry.computeVertexNormals();
    const material = solidMaterial(GOAL_COLOUR, 0.34, this.clay.uniforms);
    material.depthWrite = false;
    this.goal = new Mesh(geometry, material);
    this.goal.visible = false;
    this.scene.add(this.goal);
    this.stale = true;
  }

  showTools(tools, first, second, share) {
    for (const [number, tool] of tools.entries()) tool.place(first[number], second[number], share);
    this.stale = true;
  }

  draw() {
    if (!this.stale) return false;
    this.stale = false;
    const { light } = this.clay.uniforms;
    this.camera.updateMatrixWorld();
    light.value.copy(this.light).transformDirection(this.camera.matrixWorldInverse);
    this.renderer.render(this.scene, this.camera);
    return true;
  }
}
