// A report of dirax: reads its data, and lets motion, plots and tables move together.

import { Clock } from "./clock.js";
import { load } from "./data.js";
import { keys, player } from "./player.js";
import { PhasePlot, TimePlot, element } from "./plots.js";
import { Stage } from "./stage.js";

const SECONDS = 20; // how long the whole takes at speed 1, where the unit of time is not the second

const find = (id) => document.getElementById(id);

function colours() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  const series = Array.from({ length: 7 }, (_, k) => read(`c${k}`));
  const names = ["sky", "ink", "soft", "grid", "body", "arrow"];
  return { series, ...Object.fromEntries(names.map((name) => [name, read(name)])) };
}

function notice(text) {
  const made = element("p", { className: "notice", textContent: text });
  made.setAttribute("role", "note");
  return made;
}

function staged(data) {
  try {
    return new Stage(find("stage"), data, colours());
  } catch (error) {
    console.info(`no motion: ${error.message}`);
    find("stage").replaceChildren(notice("This browser has no WebGL, so the motion cannot be drawn. The plots and numbers are complete."));
    return null;
  }
}

// Who is who, where several move: each can be hidden.
function legend(data, stage) {
  if (data.runs.length < 2) return;
  data.runs.forEach((run, k) => {
    const shown = element("input", { type: "checkbox", checked: true });
    shown.onchange = () => {
      if (shown.checked) stage?.hidden.delete(k);
      else stage?.hidden.add(k);
      stage?.later();
    };
    const swatch = element("span", { className: "swatch", dataset: { run: k } });
    find("legend").append(element("label", {}, shown, swatch, run.label));
  });
}

function swatches(data, { series, ink }) {
  const of = (run) => (run.closed ? ink : series[run.colour % series.length]);
  for (const each of document.querySelectorAll("[data-run]")) each.style.background = of(data.runs[each.dataset.run]);
  for (const each of document.querySelectorAll("[data-group]")) {
    each.style.background = of(data.runs.find((run) => run.group === Number(each.dataset.group)));
  }
}

function prepared(data) {
  data.several = data.runs.filter((run) => run.group >= 0).length > 1;
  const groups = new Set(data.runs.map((run) => run.group)).size;
  const batch = data.runs.some((run) => run.ghost);
  data.runs.forEach((run, k) => {
    run.closed = run.group < 0;
    run.colour = batch && groups > 1 ? run.group : k;
    run.ghost = run.ghost && (groups > 1 || data.runs.length > 6);
  });
  const ends = data.runs.flatMap((run) => [run.t[0], run.t[run.t.length - 1]]);
  data.span = [Math.min(...ends), Math.max(...ends)];
}

async function start() {
  const began = performance.now();
  const data = await load(document);
  prepared(data);
  const length = data.span[1] - data.span[0];
  const clock = new Clock(data.span, data.unit === "s" && length <= 120 ? 1 : length / SECONDS || 1, data.runs[0].t);
  const say = (text) => (find("said").textContent = text);
  const stage = staged(data);
  player(find("player"), clock, stage, data.unit, say);
  legend(data, stage);
  keys(clock, stage);
  if (stage) {
    stage.canvas.tabIndex = 0;
    stage.canvas.setAttribute("role", "img");
    stage.canvas.setAttribute("aria-label", `${data.title}, moving in three dimensions. Space plays, Shift with an arrow key turns the view.`);
    clock.listen((time) => stage.show(time));
    document.documentElement.dataset.firstFrame = Math.round(performance.now() - began);
  }
  const plots = {};
  for (const chart of data.charts) {
    const plot = new (chart.kind === "phase" ? PhasePlot : TimePlot)(chart, data, clock, colours());
    find("plots").append(plot.figure);
    (plots[chart.table] ??= []).push(plot);
  }
  const all = Object.values(plots).flat();
  all.forEach((plot) => plot.build());
  clock.listen((time) => all.forEach((plot) => plot.show(time)));
  for (const button of document.querySelectorAll(".seek")) {
    button.onclick = () => {
      clock.pause();
      clock.seek(Number(button.dataset.time));
      const figure = plots[button.dataset.table]?.[0].figure ?? find("motion");
      figure.scrollIntoView({ block: "center" });
      say(`t = ${clock.time}`);
    };
  }
  const repaint = () => {
    const now = colours();
    stage?.paint(now);
    all.forEach((plot) => plot.repaint(now));
    swatches(data, now);
  };
  swatches(data, colours());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  printing(stage, repaint);
  clock.tell();
  document.documentElement.dataset.ready = Math.round(performance.now() - began);
  window.dirax = { clock, stage, data, plots: all };
}

// On paper: light colours, and the canvas as a picture.
function printing(stage, repaint) {
  const image = element("img", { alt: "The motion at the time shown" });
  addEventListener("beforeprint", () => {
    document.documentElement.dataset.theme = "light";
    repaint();
    if (!stage) return;
    stage.draw();
    image.src = stage.canvas.toDataURL("image/png");
    stage.canvas.style.display = "none";
    stage.host.append(image);
  });
  addEventListener("afterprint", () => {
    delete document.documentElement.dataset.theme;
    image.remove();
    if (stage) stage.canvas.style.display = "";
    repaint();
  });
}

start().catch((error) => {
  console.error(error);
  find("stage").replaceChildren(notice(`This page could not be shown (${error.message}): it needs a browser of 2023 or later.`));
});
