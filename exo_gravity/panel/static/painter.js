// Draws when the browser is ready, and then pauses: on a slow computer, drawing must not delay a press.

const REST = 4; // pauses for this many times as long as the last picture took

export class Painter {
  constructor(draw) {
    this.draw = draw;
    this.cost = 0; // ms
    this.waiting = false;
  }

  request() {
    if (this.waiting || document.hidden) return;
    this.waiting = true;
    setTimeout(() => requestAnimationFrame(() => this.paint()), REST * this.cost);
  }

  paint() {
    this.waiting = false;
    const start = performance.now();
    this.draw();
    this.cost = performance.now() - start;
  }
}
