// Everything beside the view: the run, its stages and candidates, figures, command, configuration.

const FIGURE_HEAD = ["figure", "start", "result", "bound", "", ""];

function counted(number, noun) { return `${number} ${noun}${number === 1 ? "" : "s"}`; }

function drawHeader(content) {
  const good = ["finished", "running"].includes(content.status);
  find("header").replaceChildren(
    element("h1", {}, content.name),
    element("span", { class: good ? "status" : "status other" }, content.status.replaceAll("_", " ")),
    element("span", { class: "summary" }, content.summary),
    element("span", { class: "muted" }, content.advice),
  );
}

function drawStages(content, chosen, choose) {
  const chips = content.stages.map((stage, number) =>
    element("button", { class: number === chosen ? "on" : null, title: `loss ${short(stage.lossBefore)} → ${short(stage.loss)}`, click: () => choose(number) }, String(stage.index + 1)));
  const waiting = content.status === "running" ? element("span", { class: "muted" }, ` of ${content.stageCount}, running`) : null;
  const plot = element("div");
  find("stages").replaceChildren(element("h2", {}, "stages"), element("div", { class: "chips" }, ...chips, waiting), plot);
  drawStageLosses(plot, content);
}

/** The candidates of a stage; choosing one that lost shows its tools, and its clay where it was rolled out. */
function drawCandidates(stage, chosen, choose) {
  const place = find("candidates");
  const head = element("h2", {}, "candidates of this stage");
  if (!stage || !stage.candidates.length) return place.replaceChildren(head, element("div", { class: "muted" }, "none was placed"));
  const order = stage.candidates.map((_, number) => number).sort((a, b) => (stage.candidates[a].loss ?? Infinity) - (stage.candidates[b].loss ?? Infinity));
  const rows = order.map((number) => {
    const candidate = stage.candidates[number];
    const won = number === stage.best;
    const what = won ? "executed" : candidate.positions ? "lost: play" : "lost: placement";
    const kind = ["choice", won ? "best" : "", number === chosen ? "chosen" : ""].join(" ");
    const pick = () => choose(won || number === chosen ? null : number);
    const row = element("tr", { class: kind, tabindex: 0, click: pick, keydown: (event) => { if (event.key === "Enter") pick(); } });
    row.append(
      element("td", {}, `${number + 1} ${candidate.label}`), element("td", { class: "number" }, short(candidate.loss)), element("td", { class: "muted" }, what),
    );
    return row;
  });
  const before = element("div", { class: "muted" }, `loss before ${short(stage.lossBefore)}; ${counted(stage.evaluations, "gradient evaluation")}, ${counted(stage.rollouts, "rollout")}`);
  return place.replaceChildren(head, element("div", { class: "scroll" }, table(["placement", { number: "loss" }, ""], rows)), before);
}

function drawFigures(content) {
  const rows = content.figures.map((figure) => {
    const meter = element("div", { class: "meter" });
    const from = figure.start ?? (figure.better === "higher" ? 0 : null);
    if (from !== null && figure.bound !== from) {
      const share = Math.min(Math.max((figure.result - from) / (figure.bound - from), 0), 1);
      meter.append(element("div", { style: `width: ${100 * share}%` }));
      meter.title = `${Math.round(100 * share)}% of the way to the bound`;
    } else meter.style.visibility = "hidden";
    const row = element("tr");
    row.append(
      element("td", {}, figure.name), ...[figure.start, figure.result, figure.bound].map((value) => element("td", { class: "number" }, short(value))),
      element("td", {}, meter), element("td", { class: "muted" }, `${figure.better} is better; ${figure.note}`),
    );
    return row;
  });
  const head = FIGURE_HEAD.map((text, at) => (at >= 1 && at <= 3 ? { number: text } : text));
  const empty = element("div", { class: "muted" }, content.status === "running" ? "computed when the run is over" : "not computed");
  find("figures").replaceChildren(element("h2", {}, "figures, and the best that can be reached"), rows.length ? table(head, rows) : empty);
}

function drawDetails(content) {
  const command = content.command ?? "This run was made in Python with objects of its own; no command line repeats it.";
  find("command").replaceChildren(element("h2", {}, "repeat this run"), element("pre", {}, command));
  find("facts").replaceChildren(element("h2", {}, "how it was made"), table(["", ""], content.facts));
  const fold = (title, value) => element("details", {}, element("summary", {}, title), element("pre", {}, JSON.stringify(value, null, 1)));
  find("configuration").replaceChildren(
    element("h2", {}, "configuration"), fold("all options", content.configuration), fold("the task with its scene", content.task),
  );
}
