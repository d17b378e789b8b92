// The player under the motion: play, scrub, speed, trails, view; and the keys of the page.

import { SPEEDS } from "./clock.js";
import { exact } from "./data.js";
import { element } from "./plots.js";

export function player(host, clock, stage, unit, say) {
  const play = element("button", { type: "button", className: "play", textContent: "Play" });
  play.onclick = () => clock.toggle();
  const slider = element("input", { type: "range", min: 0, max: 10000, step: 1, value: 0 });
  slider.setAttribute("aria-label", "time");
  slider.oninput = () => clock.seek(clock.first + ((clock.last - clock.first) * slider.value) / 10000);
  const shown = element("output");
  const speed = element("select", {}, ...SPEEDS.map((s) => element("option", { value: s, textContent: `${s}×`, selected: s === 1 })));
  speed.title = `1× is ${exact(clock.rate, 3)} ${unit || "units of time"} in a second`;
  speed.onchange = () => {
    clock.speed = Number(speed.value);
  };
  host.append(play, slider, shown, element("label", {}, "speed", speed));
  if (stage) {
    const trail = element("select", {}, ...["short", "whole", "none"].map((value) => element("option", { value, textContent: value })));
    trail.onchange = () => {
      stage.trail = trail.value;
      stage.later();
    };
    const view = element("button", { type: "button", textContent: "Reset view" });
    view.onclick = () => stage.view.reset();
    host.append(element("label", {}, "trail", trail), view);
  }
  let playing = false;
  clock.listen((time, now) => {
    const digits = Math.max(0, Math.min(6, 3 - Math.floor(Math.log10(clock.last - clock.first))));
    shown.textContent = `t = ${time.toFixed(digits)}${unit ? ` ${unit}` : ""}`;
    slider.value = Math.round((10000 * (time - clock.first)) / (clock.last - clock.first || 1));
    slider.setAttribute("aria-valuetext", shown.textContent);
    speed.value = clock.speed;
    if (now !== playing) {
      playing = now;
      play.textContent = now ? "Pause" : "Play";
      say(now ? "playing" : `paused at ${shown.textContent}`);
    }
  });
}

export function keys(clock, stage) {
  const row = (by) => {
    const { rows } = clock;
    const size = by * Math.max(1, Math.round(rows.length / 1000));
    const at = rows.findIndex((t) => t >= clock.time - 1e-12 * Math.abs(clock.last));
    clock.pause();
    clock.seek(rows[Math.min(rows.length - 1, Math.max(0, (at < 0 ? rows.length - 1 : at) + size))]);
  };
  const actions = {
    " ": () => clock.toggle(),
    ArrowLeft: () => row(-1),
    ArrowRight: () => row(1),
    Home: () => clock.seek(clock.first),
    End: () => clock.seek(clock.last),
    "[": () => clock.faster(-1),
    "]": () => clock.faster(1),
    "+": () => stage?.view.scale(1.15),
    "=": () => stage?.view.scale(1.15),
    "-": () => stage?.view.scale(1 / 1.15),
    r: () => stage?.view.reset(),
    "Shift+ArrowLeft": () => stage?.view.turn(0.08, 0),
    "Shift+ArrowRight": () => stage?.view.turn(-0.08, 0),
    "Shift+ArrowUp": () => stage?.view.turn(0, 0.08),
    "Shift+ArrowDown": () => stage?.view.turn(0, -0.08),
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { tagName } = event.target;
    if (tagName === "SELECT" || tagName === "INPUT" || (event.key === " " && ["BUTTON", "A", "SUMMARY"].includes(tagName))) return;
    const name = event.shiftKey && event.key.startsWith("Arrow") ? `Shift+${event.key}` : event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (!(name in actions)) return;
    event.preventDefault();
    actions[name]();
  });
}
