// Learning curves: the loss of each candidate of a stage over the iterations, and the loss over the stages.

const CURVE_COLOURS = ["#45699e", "#a8603c", "#3f8f6b", "#8d5a97", "#c9a227", "#5f6b73", "#b8485c", "#2f8f9d"];
const CHART_HEIGHT = 170;

/** The chart of a stage; candidates that were dropped end early. */
function drawCurves(place, content, stageIndex, chosen) {
  const lines = content.curves.filter((line) => line.stage === stageIndex);
  const batches = [...new Set(lines.map((line) => line.batch))];
  const series = batches.flatMap((batch) => {
    const own = lines.filter((line) => line.batch === batch);
    return (own[0].loss ?? []).map((_, world) => ({ batch, world, phase: own[0].phase, values: own.map((line) => line.loss[world]) }));
  });
  const head = element("h2", {}, "loss over iterations");
  if (!series.length) return place.replaceChildren(head, element("div", { class: "muted" }, "no iterations are recorded"));
  const longest = Math.max(...series.map((one) => one.values.length));
  const data = [Array.from({ length: longest }, (_, at) => at + 1)];
  for (const one of series) data.push(Array.from({ length: longest }, (_, at) => one.values[at] ?? null));
  const options = series.map((one, number) => ({
    label: `${one.phase} ${one.batch + 1}.${one.world + 1}`,
    stroke: CURVE_COLOURS[number % CURVE_COLOURS.length],
    width: number === chosen ? 3 : 1.4,
    points: { show: longest < 3 },
    value: (_, value) => short(value),
  }));
  const host = element("div");
  place.replaceChildren(head, host);
  return chart(host, data, options, "iteration");
}

/** The loss over all stages: before the first one, then after each. */
function drawStageLosses(place, content) {
  const { stages } = content;
  if (!stages.length) return null;
  const numbers = [stages[0].index, ...stages.map((stage) => stage.index + 1)];
  const losses = [stages[0].lossBefore, ...stages.map((stage) => stage.loss)];
  const options = [{ label: "loss", stroke: "#2b2621", width: 2, points: { show: true, size: 5 }, value: (_, value) => short(value) }];
  return chart(place, [numbers, losses], options, "stages done");
}

function chart(host, data, series, label) {
  const { uPlot } = libraries;
  const axis = { stroke: "#7a7167", grid: { stroke: "#eeeae2", width: 1 }, font: "11px system-ui" };
  const options = {
    width: Math.max(host.parentElement.clientWidth - 26, 240), height: CHART_HEIGHT, legend: { show: series.length > 1 && series.length <= 8 },
    scales: { x: { time: false } }, series: [{ label }, ...series],
    axes: [{ ...axis, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000], size: 28 }, { ...axis, size: 62, values: (_, ticks) => ticks.map((tick) => short(tick, 3)) }],
  };
  return new uPlot(options, data, host);
}
