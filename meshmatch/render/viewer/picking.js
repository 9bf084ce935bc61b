// Picking: the vertex under a point of the screen. All vertices are projected once for each view, which takes a
// millisecond for 100,000; then every triangle is tested for the point, which takes another two. This needs no tree,
// and nothing is read back from the graphics card.

class Picker {
  // position: 0..65535 in a cube of edge `size` around 0; face: corners, none for points of radius `radius`.
  constructor(position, face, size, radius) {
    this.position = position;
    this.face = face;
    this.size = size;
    this.radius = radius;
    this.count = position.length / 3;
    this.x = new Float32Array(this.count);
    this.y = new Float32Array(this.count);
    this.depth = new Float32Array(this.count);
    this.key = null;
  }

  // Project with `matrix` (column-major, page units to clip space) onto width x height pixels; `pixels` is the number of
  // pixels per unit at depth 1.
  look(matrix, width, height, pixels) {
    const key = [...matrix, width, height].join();
    if (key === this.key) return;
    this.key = key;
    this.pixels = pixels;
    const m = matrix,
      scale = this.size / 65535,
      half = this.size / 2;
    const { position, x, y, depth, count } = this;
    for (let i = 0, k = 0; i < count; i++, k += 3) {
      const a = position[k] * scale - half,
        b = position[k + 1] * scale - half,
        c = position[k + 2] * scale - half;
      const w = m[3] * a + m[7] * b + m[11] * c + m[15];
      if (w > 1e-6) {
        x[i] = (0.5 + (0.5 * (m[0] * a + m[4] * b + m[8] * c + m[12])) / w) * width;
        y[i] = (0.5 - (0.5 * (m[1] * a + m[5] * b + m[9] * c + m[13])) / w) * height;
        depth[i] = w;
      } else {
        x[i] = y[i] = NaN; // behind the viewer: covers nothing
        depth[i] = Infinity;
      }
    }
  }

  // {vertex, depth} of the surface nearest to the viewer at a pixel, or null.
  at(px, py) {
    return this.face.length ? this.onFaces(px, py) : this.onPoints(px, py);
  }

  onFaces(px, py) {
    const { face, x, y, depth } = this;
    let nearest = 0,
      hit = -1;
    for (let f = 0; f < face.length; f += 3) {
      const i = face[f],
        j = face[f + 1],
        k = face[f + 2];
      const ax = x[i] - px,
        bx = x[j] - px,
        cx = x[k] - px;
      if ((ax > 0 && bx > 0 && cx > 0) || (ax < 0 && bx < 0 && cx < 0)) continue;
      const ay = y[i] - py,
        by = y[j] - py,
        cy = y[k] - py;
      if ((ay > 0 && by > 0 && cy > 0) || (ay < 0 && by < 0 && cy < 0)) continue;
      const u = bx * cy - by * cx,
        v = cx * ay - cy * ax,
        w = ax * by - ay * bx;
      if (!((u >= 0 && v >= 0 && w >= 0) || (u <= 0 && v <= 0 && w <= 0))) continue;
      const total = u + v + w;
      if (total === 0) continue;
      const near = (u / depth[i] + v / depth[j] + w / depth[k]) / total; // 1 / depth is linear on the screen
      if (near > nearest) {
        nearest = near;
        hit = f;
      }
    }
    if (hit < 0) return null;
    let vertex = face[hit],
      least = Infinity;
    for (let c = 0; c < 3; c++) {
      const i = face[hit + c],
        away = (x[i] - px) ** 2 + (y[i] - py) ** 2;
      if (away < least) {
        least = away;
        vertex = i;
      }
    }
    return { vertex, depth: 1 / nearest };
  }

  onPoints(px, py) {
    const { x, y, depth, count } = this;
    let vertex = -1,
      nearest = Infinity;
    for (let i = 0; i < count; i++) {
      const dx = x[i] - px,
        dy = y[i] - py,
        reach = Math.max((this.radius * this.pixels) / depth[i], 4);
      if (dx * dx + dy * dy <= reach * reach && depth[i] < nearest) {
        nearest = depth[i];
        vertex = i;
      }
    }
    return vertex < 0 ? null : { vertex, depth: nearest };
  }
}
