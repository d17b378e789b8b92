// The bodies of a scene as three.js objects: each kind is a function (settings, look) -> { object, move(places) }.

import {
  BoxGeometry,
  BufferGeometry,
  CatmullRomCurve3,
  ConeGeometry,
  CylinderGeometry,
  DoubleSide,
  Float32BufferAttribute,
  Group,
  Line,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  SphereGeometry,
  TorusGeometry,
  TubeGeometry,
  Vector3,
} from "three";

const UP = new Vector3(0, 1, 0);

function solid(look, colour, opacity = 1) {
  const clear = opacity * look.opacity;
  return new MeshLambertMaterial({ color: colour, transparent: clear < 1, opacity: clear, depthWrite: clear === 1 });
}

function posed(object) {
  return {
    object,
    move: ({ at, turn }) => {
      object.position.copy(at);
      if (turn) object.quaternion.copy(turn);
    },
  };
}

function segments(points, colour, opacity) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(points, 3));
  return new LineSegments(geometry, new LineBasicMaterial({ color: colour, transparent: opacity < 1, opacity }));
}

// A unit cylinder along y between two points.
function stretched(object, from, to, width) {
  const along = new Vector3().subVectors(to, from);
  const length = along.length();
  object.position.addVectors(from, to).multiplyScalar(0.5);
  object.scale.set(width, Math.max(length, 1e-9), width);
  if (length > 0) object.quaternion.setFromUnitVectors(UP, along.divideScalar(length));
}

function point({ radius }, look) {
  return posed(new Mesh(new SphereGeometry(radius ?? 0.022 * look.extent, 32, 20), solid(look, look.colour)));
}

function ball({ radius }, look) {
  const group = new Group();
  const half = (colour, start) => new Mesh(new SphereGeometry(radius, 48, 24, start, Math.PI), solid(look, colour, 0.97));
  group.add(half(look.colour, 0), half(look.pale, Math.PI));
  const ring = new Mesh(new TorusGeometry(radius * 1.001, radius * 0.018, 8, 72), solid(look, look.ink));
  ring.rotation.x = Math.PI / 2;
  group.add(ring);
  return posed(group);
}

function disk({ radius, thickness }, look) {
  const group = new Group();
  const width = thickness ?? 0.12 * radius;
  const round = (geometry, colour, opacity = 1) => {
    const mesh = new Mesh(geometry, solid(look, colour, opacity));
    mesh.rotation.x = Math.PI / 2; // cylinders of three.js lie along y
    group.add(mesh);
    return mesh;
  };
  round(new CylinderGeometry(0.94 * radius, 0.94 * radius, 0.35 * width, 64), look.pale, 0.85);
  round(new CylinderGeometry(0.12 * radius, 0.12 * radius, 1.15 * width, 24), look.colour);
  const rim = new Mesh(new TorusGeometry(radius - width / 2, width / 2, 14, 72), solid(look, look.colour));
  group.add(rim);
  for (let k = 0; k < 3; k++) {
    const spoke = new Mesh(new BoxGeometry(1.9 * radius, 0.06 * radius, 0.5 * width), solid(look, look.colour));
    spoke.rotation.z = (k * Math.PI) / 3;
    group.add(spoke);
  }
  const mark = new Mesh(new SphereGeometry(0.1 * radius, 20, 12), solid(look, look.ink));
  mark.position.set(0.62 * radius, 0, 0);
  group.add(mark);
  return posed(group);
}

function box({ size }, look) {
  const group = new Group();
  group.add(new Mesh(new BoxGeometry(...size), solid(look, look.colour, 0.92)));
  const [x, y, z] = size.map((s) => s / 2);
  const corners = [-1, 1].flatMap((a) => [-1, 1].flatMap((b) => [-1, 1].map((c) => [a * x, b * y, c * z])));
  const edges = [];
  for (const p of corners) for (const q of corners) if (p < q && p.filter((v, i) => v !== q[i]).length === 1) edges.push(...p, ...q);
  group.add(segments(edges, look.ink, 0.7 * look.opacity));
  return posed(group);
}

function blade({ length }, look) {
  const size = length ?? 0.12 * look.extent;
  const group = new Group();
  const steel = new Mesh(new BoxGeometry(size, 0.04 * size, 0.22 * size), solid(look, look.colour));
  steel.position.z = 0.11 * size;
  const shoe = new Mesh(new BoxGeometry(0.85 * size, 0.22 * size, 0.1 * size), solid(look, look.ink));
  shoe.position.z = 0.27 * size;
  const nose = new Mesh(new ConeGeometry(0.09 * size, 0.3 * size, 20), solid(look, look.colour));
  nose.rotation.z = -Math.PI / 2;
  nose.position.set(0.58 * size, 0, 0.27 * size);
  group.add(steel, shoe, nose);
  return posed(group);
}

function rod({ radius }, look) {
  const mesh = new Mesh(new CylinderGeometry(1, 1, 1, 20), solid(look, look.colour));
  const width = radius ?? 0.0075 * look.extent;
  return { object: mesh, move: ({ at, end }) => stretched(mesh, at, end, width) };
}

function spring({ turns, radius }, look) {
  const width = radius ?? 0.025 * look.extent;
  const wire = [];
  for (let k = 0; k <= 24 * turns; k++) {
    const s = k / (24 * turns);
    const open = Math.min(1, 12 * s, 12 * (1 - s));
    wire.push(new Vector3(open * Math.cos(2 * Math.PI * turns * s), s - 0.5, open * Math.sin(2 * Math.PI * turns * s)));
  }
  const thickness = 0.16;
  const mesh = new Mesh(new TubeGeometry(new CatmullRomCurve3(wire), 24 * turns, thickness, 6), solid(look, look.colour));
  return { object: mesh, move: ({ at, end }) => stretched(mesh, at, end, width) };
}

function sphere({ radius }, look) {
  const group = new Group();
  const skin = new MeshLambertMaterial({ color: look.body, transparent: true, opacity: 0.13, depthWrite: false, side: DoubleSide });
  group.add(new Mesh(new SphereGeometry(radius, 64, 40), skin));
  const lines = [];
  const at = (u, v) => [radius * Math.cos(u) * Math.cos(v), radius * Math.sin(u) * Math.cos(v), radius * Math.sin(v)];
  for (let k = 0; k < 96; k++) {
    const [a, b] = [(k * Math.PI) / 48, ((k + 1) * Math.PI) / 48];
    for (let j = -2; j <= 2; j++) lines.push(...at(a, (j * Math.PI) / 6), ...at(b, (j * Math.PI) / 6));
    for (let j = 0; j < 6; j++) lines.push(...at((j * Math.PI) / 6, a), ...at((j * Math.PI) / 6, b));
  }
  group.add(segments(lines, look.body, 0.28));
  return posed(group);
}

function plane({ size }, look) {
  const group = new Group();
  const wide = size ?? 1.35 * look.extent;
  const power = 10 ** Math.floor(Math.log10(wide / 8));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => wide / s <= 16);
  const count = Math.ceil(wide / 2 / step);
  const end = count * step;
  const lines = [];
  for (let k = -count; k <= count; k++) lines.push(-end, k * step, 0, end, k * step, 0, k * step, -end, 0, k * step, end, 0);
  group.add(segments(lines, look.body, 0.3));
  const skin = new MeshLambertMaterial({ color: look.body, transparent: true, opacity: 0.06, depthWrite: false, side: DoubleSide });
  const sheet = new Mesh(new BoxGeometry(2 * end, 2 * end, 1e-4 * wide), skin);
  sheet.position.z = -4e-3 * wide;
  group.add(sheet);
  return posed(group);
}

function axes({ length }, look) {
  const size = length ?? 0.5 * look.extent;
  const group = new Group();
  const lines = [];
  for (const axis of [[1, 0, 0], [0, 1, 0], [0, 0, 1]]) {
    lines.push(0, 0, 0, ...axis.map((x) => size * x));
    const tip = new Mesh(new ConeGeometry(0.018 * size, 0.07 * size, 16), solid(look, look.body));
    tip.quaternion.setFromUnitVectors(UP, new Vector3(...axis));
    tip.position.set(...axis.map((x) => size * x));
    group.add(tip);
  }
  group.add(segments(lines, look.body, 0.8));
  return posed(group);
}

function arrow({ scale }, look) {
  const group = new Group();
  const width = 0.009 * look.extent;
  const shaft = new Mesh(new CylinderGeometry(1, 1, 1, 20), solid(look, look.colour));
  const tip = new Mesh(new ConeGeometry(1, 1, 28), solid(look, look.colour));
  group.add(shaft, tip);
  const move = ({ at, vector }) => {
    const length = scale * vector.length();
    const head = Math.min(5 * width, length);
    const along = new Vector3().copy(vector).normalize();
    const neck = new Vector3().copy(at).addScaledVector(along, length - head);
    const end = new Vector3().copy(at).addScaledVector(along, length);
    group.visible = length > 0;
    stretched(shaft, at, neck, width);
    stretched(tip, neck, end, 1);
    tip.scale.set(2.4 * width, head, 2.4 * width);
  };
  return { object: group, move };
}

export const KINDS = { point, ball, disk, box, blade, rod, spring, sphere, plane, axes, arrow };

// A thin line through points [x, y, z, …].
export function thread(points, colour, opacity) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(points, 3));
  return new Line(geometry, new LineBasicMaterial({ color: colour, transparent: true, opacity, depthWrite: false }));
}


