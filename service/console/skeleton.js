// Draws a skeleton document on a canvas: orthographic, turned by dragging, zoomed by the wheel.

const OBSERVED = "#3a86ff";
const PREDICTED = "#fb8500";
const MARGIN = 0.92;

export class SkeletonView {
  #canvas;
  #document = null;
  // The arm looks along +x: the first sight is the camera's, y to the left, z up.
  #turn = { azimuth: 0, elevation: 0.12, zoom: 1 };

  constructor(canvas) {
    this.#canvas = canvas;
    new ResizeObserver(() => this.#draw()).observe(canvas);
    canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = (event) => {
      if (!event.buttons) return;
      this.#turn.azimuth -= event.movementX / 150;
      const elevation = this.#turn.elevation + event.movementY / 150;
      this.#turn.elevation = Math.max(-1.5, Math.min(1.5, elevation));
      this.#draw();
    };
    canvas.onwheel = (event) => {
      event.preventDefault();
      this.#turn.zoom *= Math.exp(-event.deltaY / 500);
      this.#draw();
    };
  }

  show(skeleton) {
    this.#document = skeleton;
    this.#draw();
  }

  #draw() {
    const canvas = this.#canvas;
    canvas.width = canvas.clientWidth * devicePixelRatio;
    canvas.height = canvas.clientHeight * devicePixelRatio;
    const positions = this.#document?.vertices.position ?? [];
    if (!positions.length || !canvas.width) return;
    const { points, scale } = this.#project(positions);
    const pen = canvas.getContext("2d");
    pen.lineCap = "round";
    const { radius, occluded } = this.#document.vertices;
    for (const [a, b] of this.#document.edges) {
      const hidden = occluded[a] || occluded[b];
      pen.strokeStyle = hidden ? PREDICTED : OBSERVED;
      pen.lineWidth = Math.max(1.2 * devicePixelRatio, (radius[a] + radius[b]) * scale);
      pen.beginPath();
      pen.moveTo(...points[a]);
      pen.lineTo(...points[b]);
      pen.stroke();
    }
  }

  #project(positions) {
    const { azimuth, elevation, zoom } = this.#turn;
    const middle = [0, 1, 2].map((axis) => {
      const [low, high] = extent(positions, axis);
      return (low + high) / 2;
    });
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation),
      Math.sin(elevation)];
    const flat = positions.map(([x, y, z]) => {
      const [dx, dy, dz] = [x - middle[0], y - middle[1], z - middle[2]];
      const away = ca * dx + sa * dy;
      return [sa * dx - ca * dy, -(ce * dz + se * away)];
    });
    const { width, height } = this.#canvas;
    // The size fits the whole tree from any side, so that turning does not make it breathe.
    const [low, high] = extent(positions, 2);
    const across = Math.max(...[0, 1].map((axis) => {
      const [a, b] = extent(positions, axis);
      return b - a;
    }));
    const scale = zoom * MARGIN * Math.min(height / (high - low || 1), width / (across || 1));
    const points = flat.map(([x, y]) => [width / 2 + x * scale, height / 2 + y * scale]);
    return { points, scale };
  }
}

function extent(positions, axis) {
  let [low, high] = [Infinity, -Infinity];
  for (const position of positions) {
    low = Math.min(low, position[axis]);
    high = Math.max(high, position[axis]);
  }
  return [low, high];
}
