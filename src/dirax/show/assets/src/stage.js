// The motion: every actor (a trajectory) moves its own copy of the scene's bodies; what never moves is there once.

import { Box3, Color, DirectionalLight, Group, HemisphereLight, Quaternion, Scene, Vector3, WebGLRenderer } from "three";
import { Line2 } from "three/examples/jsm/lines/Line2.js";
import { LineGeometry } from "three/examples/jsm/lines/LineGeometry.js";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { KINDS, thread } from "./bodies.js";
import { before } from "./data.js";
import { View } from "./view.js";

const TAIL = 400; // points of the bright end of a trail

export class Stage {
  // Raises where there is no WebGL.
  constructor(host, data, colours) {
    this.host = host;
    this.data = data;
    this.canvas = document.createElement("canvas");
    this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio || 1));
    this.trail = "short";
    this.hidden = new Set();
    this.time = data.span[0];
    this.measure();
    this.view = new View(data.scene.view, this.box, this.spots, 0.04 * this.extent, () => this.later());
    this.view.follow(this.canvas);
    this.paint(colours);
    host.append(this.canvas);
    new ResizeObserver(() => this.resize()).observe(host);
    this.resize();
  }

  // The places that the picture must show, with the room about each; the box about them, and its size.
  measure() {
    this.spots = [];
    this.box = new Box3();
    const at = new Vector3();
    for (const actor of this.data.scene.actors) {
      for (const part of this.data.scene.parts) {
        if (part.kind === "plane" || part.kind === "axes") continue;
        for (const [name, place] of Object.entries(part.places)) {
          if (name === "turn" || name === "vector") continue;
          const count = place.constant ? 1 : actor.t.length;
          const reach = ["disk", "ball", "sphere"].includes(part.kind) ? part.radius : part.kind === "box" ? Math.hypot(...part.size) / 2 : 0;
          for (let i = 0; i < count; i += Math.max(1, Math.floor(count / 400))) {
            if (!spot(place, actor, i, 0, at)) break;
            this.spots.push({ at: at.clone(), reach });
            if (part.kind === "arrow" && spot(part.places.vector, actor, i, 0, at)) {
              const tip = at.clone().multiplyScalar(part.scale).add(this.spots.at(-1).at);
              this.spots.push({ at: tip, reach: 0 });
            }
          }
        }
      }
    }
    for (const { at: each, reach } of this.spots) {
      this.box.expandByPoint(each.clone().addScalar(reach)).expandByPoint(each.clone().addScalar(-reach));
    }
    if (this.box.isEmpty()) this.box.set(new Vector3(-1, -1, -1), new Vector3(1, 1, 1));
    const size = this.box.getSize(new Vector3());
    this.extent = Math.max(size.x, size.y, size.z, 1e-6);
  }

  // Builds everything in these colours.
  paint(colours) {
    this.colours = colours;
    this.scene = new Scene();
    this.scene.background = new Color(colours.sky);
    this.scene.add(new HemisphereLight(0xffffff, 0xb4b4ae, 2.5));
    const sun = new DirectionalLight(0xffffff, 1.7);
    sun.position.set(-0.5, -0.9, 1.6);
    this.scene.add(sun);
    const still = ({ places }) => Object.values(places).every((place) => place.constant);
    this.actors = this.data.scene.actors.map((actor, k) => this.actor(actor, k, this.data.scene.parts.filter((part) => !still(part))));
    for (const part of this.data.scene.parts.filter(still)) {
      const body = KINDS[part.kind]?.(part, this.look(part, 0));
      if (!body) continue;
      body.move(this.places(part, null, 0, 0));
      if (part.kind === "plane" && part.size === null) {
        const middle = this.box.getCenter(new Vector3());
        if (!part.places.turn || part.places.turn.constant[0] === 1) body.object.position.set(middle.x, middle.y, body.object.position.z);
      }
      this.scene.add(body.object);
    }
    this.later();
  }

  look(part, k) {
    const { colours } = this;
    const run = this.data.runs[k];
    const several = this.data.several;
    const own = run.closed ? colours.ink : colours.series[run.colour % colours.series.length];
    const named = { ink: colours.body, accent: colours.arrow };
    let colour = own;
    if (part.colour in named) colour = named[part.colour];
    else if (typeof part.colour === "number" && !several) colour = colours.series[part.colour % colours.series.length];
    else if (typeof part.colour === "string") colour = part.colour;
    const pale = new Color(colour).lerp(new Color(colours.sky), 0.62);
    return { colour, pale, ink: colours.ink, body: colours.body, extent: this.extent, opacity: run.ghost ? 0.38 : run.closed ? 0.55 : 1 };
  }

  actor(actor, k, parts) {
    const group = new Group();
    const bodies = [];
    const trails = [];
    for (const part of parts) {
      const look = this.look(part, k);
      if (part.kind !== "path") {
        const body = KINDS[part.kind](part, look);
        if (this.places(part, actor, 0, 0)) {
          group.add(body.object);
          bodies.push({ part, body });
        }
      }
      if ((part.trail || part.kind === "path") && spot(part.places.at, actor, 0, 0, new Vector3())) {
        trails.push(this.trailOf(part, actor, look, group));
      }
    }
    this.scene.add(group);
    return { actor, group, bodies, trails, k };
  }

  trailOf(part, actor, look, group) {
    const count = actor.t.length;
    const points = new Float32Array(3 * count);
    const at = new Vector3();
    for (let i = 0; i < count; i++) spot(part.places.at, actor, i, 0, at).toArray(points, 3 * i);
    const whole = thread(points, look.colour, (part.kind === "path" ? 0.75 : 0.4) * look.opacity);
    const tail = new Line2(
      new LineGeometry(),
      new LineMaterial({ color: look.colour, linewidth: 2.5, transparent: true, opacity: 0.9 * look.opacity, depthWrite: false }),
    );
    tail.frustumCulled = whole.frustumCulled = false;
    group.add(whole);
    if (part.kind !== "path") group.add(tail);
    return { points, whole, tail, path: part.kind === "path", opacity: 0.4 * look.opacity };
  }

  places(part, actor, i, s) {
    const found = {};
    for (const [name, place] of Object.entries(part.places)) {
      const value = name === "turn" ? attitude(place, actor, i, s, new Quaternion()) : spot(place, actor, i, s, new Vector3());
      if (!value) return null;
      found[name] = value;
    }
    return found;
  }

  show(time) {
    this.time = time;
    this.later();
  }

  later() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = undefined;
      this.draw();
    });
  }

  draw() {
    for (const { actor, group, bodies, trails, k } of this.actors) {
      group.visible = !this.hidden.has(k);
      if (!group.visible) continue;
      const i = before(actor.t, this.time);
      const gap = actor.t[i + 1] - actor.t[i];
      const s = gap > 0 ? Math.min(1, Math.max(0, (this.time - actor.t[i]) / gap)) : 0;
      for (const { part, body } of bodies) body.move(this.places(part, actor, i, s));
      for (const trail of trails) this.drawTrail(trail, actor, i, s);
    }
    this.renderer.render(this.scene, this.view.camera);
    this.drawn = (this.drawn ?? 0) + 1;
  }

  // The bright tail behind a body, of about an eighth of the whole time.
  drawTrail({ points, whole, tail, path, opacity }, actor, i, s) {
    const { trail } = this;
    whole.visible = path || trail !== "none";
    whole.material.opacity = path ? 0.75 : trail === "whole" ? 2 * opacity : opacity;
    tail.visible = trail === "short" && i + s > 0;
    if (!tail.visible || path) return;
    const length = Math.max(2, Math.round(actor.t.length / 8));
    const first = Math.max(0, i - length);
    const stride = Math.max(1, Math.ceil((i - first) / TAIL));
    const shown = [];
    for (let j = i; j >= first; j -= stride) shown.push(points[3 * j], points[3 * j + 1], points[3 * j + 2]);
    const next = 3 * Math.min(i + 1, actor.t.length - 1);
    const head = [0, 1, 2].map((c) => points[3 * i + c] * (1 - s) + points[next + c] * s);
    tail.geometry.dispose();
    tail.geometry = new LineGeometry().setPositions([...head, ...shown]);
  }

  resize() {
    const { clientWidth, clientHeight } = this.host;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.view.resize(clientWidth, clientHeight);
    this.draw();
  }
}

// The point of a place between frames i and i + 1, null where the actor has none.
function spot(place, actor, i, s, into) {
  if (place.constant) return into.set(...place.constant);
  const columns = actor.channels[place.channel];
  return columns && into.set(...[0, 1, 2].map((c) => between(columns[c], i, s)));
}

const following = new Quaternion();

function attitude(place, actor, i, s, into) {
  const set = (quaternion, j) => {
    const [w, x, y, z] = place.constant ?? actor.channels[place.channel].map((column) => between(column, j, 0));
    return quaternion.set(x, y, z, w);
  };
  if (!place.constant && !actor.channels[place.channel]) return null;
  set(into, i).normalize();
  return s > 0 && !place.constant ? into.slerp(set(following, i + 1).normalize(), s) : into;
}

function between(column, i, s) {
  if (typeof column === "number") return column;
  const next = Math.min(i + 1, column.length - 1);
  return s > 0 ? column[i] * (1 - s) + column[next] * s : column[Math.min(i, column.length - 1)];
}
