// The time that is shown: everything that moves listens to it.

export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 10];

export class Clock {
  // `span`: [first, last] time; `rate`: units of time in one second at speed 1.
  constructor(span, rate, rows) {
    [this.first, this.last] = span;
    this.rate = rate;
    this.rows = rows; // the times to step through
    this.time = this.first;
    this.speed = 1;
    this.playing = false;
    this.listeners = [];
    this.previous = 0;
  }

  listen(listener) {
    this.listeners.push(listener);
  }

  tell() {
    for (const listener of this.listeners) listener(this.time, this.playing);
  }

  seek(time) {
    this.time = Math.min(this.last, Math.max(this.first, time));
    this.tell();
  }

  play() {
    if (this.time >= this.last) this.time = this.first;
    this.playing = true;
    this.previous = performance.now();
    this.tell();
    requestAnimationFrame((now) => this.tick(now));
  }

  pause() {
    this.playing = false;
    this.tell();
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  tick(now) {
    if (!this.playing) return;
    const seconds = Math.min(0.25, Math.max(0, now - this.previous) / 1000);
    this.previous = now;
    this.time += seconds * this.rate * this.speed;
    if (this.time >= this.last) {
      this.time = this.last;
      this.playing = false;
    }
    this.tell();
    requestAnimationFrame((next) => this.tick(next));
  }

  faster(by) {
    const place = SPEEDS.indexOf(this.speed) + by;
    this.speed = SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, place))];
    this.tell();
  }
}
