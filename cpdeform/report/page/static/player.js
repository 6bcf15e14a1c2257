// The player: which moment of which stage is shown, and how time goes on.

const STEPS_PER_SECOND = 8;
const HOLD_SECONDS = 1;
const WAY_SECONDS = 1.5;
const MEASURED_SECONDS = 2;

/** Positions on the way from one frame to the next, as lengths. */
function mixed(first, second, share) {
  const result = new Float32Array(first.length);
  for (let place = 0; place < first.length; place += 1) result[place] = (first[place] + share * (second[place] - first[place])) / QUANTA;
  return result;
}

class Player {
  constructor(content, view) {
    this.view = view;
    this.stage = 0;
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.candidate = null;
    this.colour = "height";
    this.showGoal = false;
    this.decoded = new Map();
    this.drawn = [];
    this.listeners = [];
    this.setContent(content);
  }

  setContent(content) {
    this.content = content;
    this.view.content = content;
  }

  get current() { return this.content.stages[this.stage]; }

  /** What plays: the executed plan, or a candidate that lost and was rolled out. */
  get source() {
    const { current } = this;
    const other = this.candidate === null ? null : current.candidates[this.candidate];
    return other?.positions ? other : current;
  }

  get lastTime() { return Math.max(this.source.frames - 1, 0); }

  /** Where the time of a stage begins: below zero while the tools are on their way from the stage before. */
  get firstTime() { return this.current.way?.length && this.candidate === null ? -WAY_SECONDS * STEPS_PER_SECOND : 0; }

  changed() { for (const listener of this.listeners) listener(); }

  async goTo(stage, time, candidate = null) {
    this.stage = Math.min(Math.max(stage, 0), this.content.stages.length - 1);
    this.candidate = candidate;
    this.time = Math.min(Math.max(time, 0), this.lastTime);
    await this.show();
    this.changed();
  }

  async frames(name) {
    if (!this.decoded.has(name)) {
      this.decoded.set(name, loadBytes(name).then((bytes) => decodeFrames(bytes, this.content.particles)));
    }
    return this.decoded.get(name);
  }

  async levels(stage) {
    if (!stage.priorities) return null;
    const { array } = stage.priorities;
    if (!this.decoded.has(array)) this.decoded.set(array, loadBytes(array));
    return this.decoded.get(array);
  }

  async distanceField() {
    if (!this.field) this.field = loadBytes(this.content.goal.distance.array);
    return this.field;
  }

  /** Shows the moment. */
  async show() {
    const { current, source } = this;
    const time = Math.max(this.time, 0);
    const at = Math.min(Math.floor(time), Math.max(this.lastTime - 1, 0));
    const share = Math.min(time, this.lastTime) - at;
    await this.showClay(at, share);
    const posesOf = (poses) => [poses[Math.min(at, poses.length - 1)], poses[Math.min(at + 1, poses.length - 1)]];
    const other = this.candidate === null ? null : current.candidates[this.candidate];
    if (this.time < 0) this.showWay(current.way, 1 - this.time / this.firstTime);
    else this.view.showTools(this.view.tools, ...posesOf(current.poses), share);
    if (other) this.view.showTools(this.view.otherTools, ...posesOf(other.poses), share);
    for (const tool of this.view.tools) tool.mesh.visible = !(other && other.positions);
    for (const tool of this.view.otherTools) tool.mesh.visible = Boolean(other);
    this.view.stale = true;
  }

  /** Shows the clay between a frame and the next one, unless it is shown already. */
  async showClay(at, share) {
    const { source, colour } = this;
    const key = [source.positions, at, share, colour, this.view.clay.asParticles].join();
    if (key === this.shown) return;
    const frames = await this.frames(source.positions);
    const positions = mixed(frames[at], frames[Math.min(at + 1, frames.length - 1)], share);
    const levels = colour === "priority" ? await this.levels(this.current) : null;
    const field = colour === "error" ? await this.distanceField() : null;
    const { nodes } = this.content.goal.distance;
    this.view.clay.show(positions, { levels, place: field && ((places) => goalDistances(places, field, nodes)) });
    this.shown = key;
  }

  /** Shows the tools on their way to the stage, of which a share lies behind them. */
  showWay(way, share) {
    const place = share * (way.length - 1);
    const at = Math.min(Math.floor(place), way.length - 2);
    this.view.showTools(this.view.tools, way[at], way[at + 1], place - at);
  }

  setColour(name) {
    const known = name === "priority" && !this.current?.priorities ? "height" : name;
    this.colour = known;
    this.view.clay.showColours(this.content.colours[known], known === "height");
  }

  /** What the colours stand for: name, least and largest value. */
  scale() {
    const { low, high } = this.content.bounds;
    if (this.colour === "priority" && this.current.priorities) return ["transport priority", this.current.priorities.low, this.current.priorities.high];
    if (this.colour === "error") return ["outside of the goal by (length)", 0, this.content.goal.distance.farthest];
    return ["height (length)", low[1], high[1]];
  }

  async setParticles(on) {
    this.view.clay.asParticles = on;
    await this.show();
    this.changed();
  }

  setGoal(on) {
    this.showGoal = on;
    if (this.view.goal) this.view.goal.visible = on;
    this.view.stale = true;
  }

  play(on) {
    if (on && this.stage === this.content.stages.length - 1 && this.time >= this.lastTime) { this.stage = 0; this.time = 0; }
    this.playing = on;
    this.changed();
  }

  /** Called for each picture of the screen. */
  async tick(now) {
    const passed = Math.min((now - (this.before ?? now)) / 1000, 0.25);
    this.before = now;
    if (this.playing && this.content.stages.length) await this.advance(passed);
    if (this.view.draw()) this.count(now);
  }

  async advance(passed) {
    this.time += passed * this.speed * STEPS_PER_SECOND;
    const last = this.stage === this.content.stages.length - 1 || this.candidate !== null;
    if (this.time >= this.lastTime + (last ? HOLD_SECONDS * STEPS_PER_SECOND : 0)) {
      if (last && this.candidate === null) this.stage = 0;
      else if (!last) this.stage += 1;
      this.time = this.firstTime;
      await this.show();
      this.changed();
      return;
    }
    const time = this.time;
    this.time = Math.min(time, this.lastTime);
    await this.show();
    this.time = time;
    this.moved?.();
  }

  /** Pictures drawn a second, over the last two seconds. */
  count(now) {
    this.drawn.push(now);
    while (this.drawn[0] < now - 1000 * MEASURED_SECONDS) this.drawn.shift();
    document.documentElement.dataset.pictures = Number(document.documentElement.dataset.pictures ?? 0) + 1;
    const seconds = (now - this.drawn[0]) / 1000;
    if (seconds > 0) document.documentElement.dataset.framesPerSecond = ((this.drawn.length - 1) / seconds).toFixed(1);
  }
}
