// Looking at the scene: a camera on a sphere about the middle of the motion, turned by pointer, wheel and keys.

import { PerspectiveCamera, Vector3 } from "three";

const OPENING = 26;
const STEEPEST = 1.5533; // 89 degrees

export class View {
  // `spots`: what must be seen, { at, reach }; `margin`: room about each.
  constructor(direction, box, spots, margin, changed) {
    this.camera = new PerspectiveCamera(OPENING, 1, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.box = box;
    this.spots = spots;
    this.margin = margin;
    this.changed = changed;
    this.start = new Vector3(...direction).normalize();
    this.reset(false);
  }

  reset(tell = true) {
    this.azimuth = Math.atan2(this.start.y, this.start.x);
    this.elevation = Math.min(STEEPEST, Math.max(-STEEPEST, Math.asin(this.start.z)));
    this.zoom = 1;
    this.target = this.box.getCenter(new Vector3());
    this.place();
    if (tell) this.changed();
  }

  resize(width, height) {
    this.camera.aspect = width / height;
    this.place();
  }

  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.min(STEEPEST, Math.max(-STEEPEST, this.elevation + elevation));
    this.place();
    this.changed();
  }

  scale(factor) {
    this.zoom = Math.min(40, Math.max(0.2, this.zoom * factor));
    this.place();
    this.changed();
  }

  // Puts the camera where every spot is just seen at zoom 1, in the middle of the picture.
  place() {
    const level = Math.cos(this.elevation);
    const towards = new Vector3(level * Math.cos(this.azimuth), level * Math.sin(this.azimuth), Math.sin(this.elevation));
    const right = new Vector3(-Math.sin(this.azimuth), Math.cos(this.azimuth), 0);
    const above = new Vector3().crossVectors(towards, right);
    const high = Math.tan((OPENING * Math.PI) / 360);
    const target = this.target.clone();
    for (const [axis, room] of [[right, high * this.camera.aspect], [above, high]]) {
      // seen from a distance d, a spot is inside where |across| + reach <= room (d - nearness)
      let [least, most] = [Infinity, -Infinity];
      for (const { at, reach } of this.spots) {
        const to = at.clone().sub(this.target);
        const [across, near] = [to.dot(axis), to.dot(towards)];
        least = Math.min(least, across - reach - this.margin - room * near);
        most = Math.max(most, across + reach + this.margin + room * near);
      }
      if (this.spots.length) target.addScaledVector(axis, (least + most) / 2);
    }
    let distance = this.margin;
    for (const { at, reach } of this.spots) {
      const to = at.clone().sub(target);
      const across = (Math.abs(to.dot(right)) + reach + this.margin) / (high * this.camera.aspect);
      distance = Math.max(distance, Math.max(across, (Math.abs(to.dot(above)) + reach + this.margin) / high) + to.dot(towards));
    }
    distance /= this.zoom;
    this.camera.position.copy(target).addScaledVector(towards, distance);
    this.camera.near = distance / 200;
    this.camera.far = distance * 40;
    this.camera.lookAt(target);
    this.camera.updateProjectionMatrix();
  }

  // Drag turns; the wheel zooms where the picture has the focus or with Ctrl, so that the page still scrolls; two fingers zoom.
  follow(canvas) {
    const fingers = new Map();
    let spread = 0;
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 2) {
        const [a, b] = [...fingers.values()];
        const now = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (spread) this.scale(now / spread);
        spread = now;
      } else this.turn((last[0] - event.clientX) / 160, (event.clientY - last[1]) / 160);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => {
        fingers.delete(event.pointerId);
        spread = 0;
      });
    }
    const wheel = (event) => {
      if (!event.ctrlKey && document.activeElement !== canvas) return;
      event.preventDefault();
      this.scale(Math.exp(-event.deltaY / 600));
    };
    canvas.addEventListener("wheel", wheel, { passive: false });
  }
}
