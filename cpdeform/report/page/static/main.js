// Puts the page together, and keeps it up to date while a run goes on.

const POLL_SECONDS = 2;
const COLOURS = ["height", "priority", "error"];

function readAddress() {
  const values = new URLSearchParams(location.hash.slice(1));
  const number = (name) => (values.has(name) ? Number(values.get(name)) : null);
  const flag = (name) => (values.has(name) ? values.get(name) === "1" : null);
  return { stage: number("stage"), step: number("step"), colour: values.get("colour"), goal: flag("goal"), play: flag("play"), view: values.get("view") };
}

function button(text, press, attributes = {}) { return element("button", { type: "button", click: press, ...attributes }, text); }

function makeControls(player) {
  const group = (title, ...buttons) => element("span", { class: "group" }, element("span", {}, title), ...buttons);
  const colours = COLOURS.map((name) => button(name, async () => { player.setColour(name); await player.show(); player.changed(); }, { "data-colour": name }));
  const views = Object.keys(VIEWS).map((name) => button(name === "default" ? "reset" : name, () => player.view.look(...VIEWS[name])));
  const goal = button("goal", () => { player.setGoal(!player.showGoal); player.changed(); }, { id: "goal" });
  const particles = button("particles", () => player.setParticles(!player.view.clay.asParticles), { id: "particles" });
  find("toolbar").replaceChildren(group("colour", ...colours), group("show", goal, particles), group("camera", ...views));
  const play = button("play", () => player.play(!player.playing), { id: "play" });
  const time = element("input", { id: "time", type: "range", min: 0, step: "any", "aria-label": "time in the stage" });
  time.addEventListener("input", async () => { player.playing = false; player.time = Math.min(Number(time.value), player.lastTime); await player.show(); player.changed(); });
  const speed = element("select", { "aria-label": "speed", change: (event) => { player.speed = Number(event.target.value); } },
    ...[0.25, 0.5, 1, 2, 4].map((value) => element("option", { value, selected: value === 1 }, `${value}×`)));
  find("transport").replaceChildren(
    play, button("‹", () => player.goTo(player.stage - 1, 0), { title: "stage before" }), time, button("›", () => player.goTo(player.stage + 1, 0), { title: "next stage" }), speed,
  );
  player.moved = () => {
    time.max = player.lastTime;
    time.value = player.time;
    const { current, content } = player;
    const step = Math.min(Math.max(Math.floor(player.time), 0), player.lastTime);
    const other = player.candidate === null ? "" : `, candidate ${player.candidate + 1} (lost)`;
    const going = player.time < 0 ? ", tools on their way" : "";
    const resting = current.status === "finished" || current.status === "interrupted" ? "" : `, ${current.status.replaceAll("_", " ")}`;
    const text = `stage ${current.index + 1} of ${content.stageCount}, step ${step} of ${player.lastTime}${going}${other}${resting}`;
    if (find("caption").textContent !== text) find("caption").textContent = text;
  };
  document.addEventListener("keydown", (event) => {
    if (event.target.matches("input, select, button, tr, summary")) return;
    const moves = { ArrowRight: 1, ArrowLeft: -1 };
    if (event.key === " ") { event.preventDefault(); player.play(!player.playing); }
    else if (event.key in moves) { player.playing = false; player.goTo(player.stage, Math.round(player.time) + moves[event.key], player.candidate); }
  });
}

function drawLegend(player) {
  const [name, low, high] = player.scale();
  const stops = player.content.colours[player.colour];
  const ends = element("div", { class: "ends" }, element("span", {}, short(low, 3)), element("span", {}, short(high, 3)));
  find("legend").replaceChildren(name, element("div", { class: "bar", style: `background: linear-gradient(to right, ${stops.join()})` }), ends);
}

/** Draws what depends on the chosen stage and candidate, unless it is drawn already. */
function drawChoice(player) {
  const { content } = player;
  player.moved();
  find("play").textContent = player.playing ? "pause" : "play";
  find("goal").classList.toggle("on", player.showGoal);
  find("particles").classList.toggle("on", player.view.clay.asParticles);
  for (const one of document.querySelectorAll("[data-colour]")) {
    one.classList.toggle("on", one.dataset.colour === player.colour);
    one.disabled = one.dataset.colour === "priority" && !player.current.priorities;
  }
  drawLegend(player);
  const key = [player.stage, player.candidate, content.stages.length, content.curves.length].join();
  if (key === drawChoice.key) return;
  drawChoice.key = key;
  const choose = (number) => player.goTo(player.stage, 0, number).then(() => player.play(number !== null));
  drawStages(content, player.stage, (number) => player.goTo(number, 0));
  drawCandidates(player.current, player.candidate, choose);
  drawCurves(find("curves"), content, player.current.index, player.candidate);
}

function drawAll(content) {
  drawHeader(content);
  drawFigures(content);
  drawDetails(content);
}

/** While the run goes on: asks for the content, and moves on to a new stage where the last one was shown. */
async function follow(player) {
  const content = await loadContent();
  const before = player.content.stages.length;
  const following = player.stage >= before - 1 && !player.playing;
  player.setContent(content);
  drawAll(content);
  if (content.stages.length > before && following) await player.goTo(content.stages.length - 1, 0);
  else if (content.stages.length) {
    // A joint polish may have revised the stage.
    await player.show();
    player.changed();
  }
}

/** Shows what the address asks for; what it does not name stays as it is. */
async function obey(player) {
  const asked = readAddress();
  if (asked.view in VIEWS) player.view.look(...VIEWS[asked.view]);
  if (COLOURS.includes(asked.colour)) player.setColour(asked.colour);
  if (asked.stage !== null || asked.step !== null) {
    const first = player.content.stages[0].index + 1;
    await player.goTo(asked.stage === null ? player.stage : asked.stage - first, asked.step ?? 0);
  } else await player.show();
  if (asked.goal !== null) player.setGoal(asked.goal);
  if (asked.play !== null) player.play(asked.play);
  player.changed();
}

async function start() {
  let content = await loadContent();
  drawAll(content);
  while (!content.stages.length) {
    find("caption").textContent = LIVE ? "waiting for the first stage" : "no stage of this run is complete";
    drawCurves(find("curves"), content, content.curves.at(-1)?.stage ?? 0, null);
    if (!LIVE) return;
    await new Promise((done) => setTimeout(done, 1000 * POLL_SECONDS));
    content = await loadContent();
    drawAll(content);
  }
  const asked = readAddress();
  const view = new View(find("canvas"), content);
  const player = new Player(content, view);
  await view.loadTools();
  makeControls(player);
  player.listeners.push(() => drawChoice(player));
  if (asked.view in VIEWS) view.look(...VIEWS[asked.view]);
  player.setColour(COLOURS.includes(asked.colour) ? asked.colour : "height");
  await player.goTo((asked.stage ?? content.stages[0].index + 1) - content.stages[0].index - 1, asked.step ?? 0);
  view.draw();
  document.documentElement.dataset.firstPicture = performance.now().toFixed(0);
  const loop = async (now) => { await player.tick(now); requestAnimationFrame(loop); };
  requestAnimationFrame(loop);
  await view.loadGoal();
  player.setGoal(asked.goal === true);
  player.changed();
  if (asked.play) player.play(true);
  window.addEventListener("hashchange", () => obey(player));
  window.cpdeform = { player, view };
  document.documentElement.dataset.ready = "true";
  while (LIVE) {
    await new Promise((done) => setTimeout(done, 1000 * POLL_SECONDS));
    await follow(player).catch((error) => { find("caption").textContent = `the server does not answer (${error.message})`; });
  }
}

start().catch((error) => {
  find("view").replaceChildren(element("div", { class: "notice" }, `This page cannot be drawn: ${error.message}`));
  document.documentElement.dataset.error = error.stack ?? String(error);
});
