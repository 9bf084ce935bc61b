// One shape as three.js draws it. Every color scheme is an attribute from the start; selecting one sets a uniform.

const MODES = { matches: 0, look: 1, own: 1, confidence: 2, plain: 3 };

const VERTEX = `
  attribute vec3 tint, paint;
  attribute float confidence;
  uniform int mode;
  uniform float pointSize;
  varying vec3 vColor, vNormal, vEye;
  varying float vSure;
  void main() {
    vec4 eye = modelViewMatrix * vec4(position, 1.0);
    vEye = eye.xyz;
    vNormal = normalMatrix * normal;
    vSure = confidence;
    vColor = mode == 0 ? tint : mode == 1 ? paint : vec3(0.80, 0.79, 0.77);
    gl_Position = projectionMatrix * eye;
    gl_PointSize = max(pointSize / -eye.z, 1.5);
  }`;

const FRAGMENT = `
  uniform int mode;
  uniform vec3 ramp[STEPS];
  varying vec3 vColor;
  varying float vSure;
  ${LIGHT}
  vec3 ofConfidence(float confidence) { // the legend's scale
    float at = confidence * float(STEPS - 1);
    int low = min(int(at), STEPS - 2);
    return mix(ramp[low], ramp[low + 1], at - float(low));
  }
  void main() {
    if (points) {
      vec2 disc = 2.0 * gl_PointCoord - 1.0;
      if (dot(disc, disc) > 1.0) discard;
    }
    vec3 color = mode == 2 ? ofConfidence(clamp(vSure, 0.0, 1.0)) : vColor;
    gl_FragColor = vec4(lit(pow(color, vec3(2.2))), 1.0);
  }`;

const LINE_VERTEX = 'void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }';
const LINE_FRAGMENT = 'uniform float strength; void main() { gl_FragColor = vec4(0.0, 0.0, 0.0, strength); }';

function geometryOf(attributes) {
  const geometry = new THREE.BufferGeometry();
  for (const [name, [array, width]] of Object.entries(attributes))
    if (array) geometry.setAttribute(name, new THREE.BufferAttribute(array, width, true));
  geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(0.5, 0.5, 0.5), 1);
  return geometry;
}

// Rows of three numbers.
function rowsOf(array, rows) {
  const out = new array.constructor(3 * rows.length);
  for (let i = 0; i < rows.length; i++) for (let c = 0; c < 3; c++) out[3 * i + c] = array[3 * rows[i] + c];
  return out;
}

// Mean edge length of a few hundred triangles, relative to the cube's edge.
function usualEdge(position, face) {
  const step = 3 * Math.max(1, Math.floor(face.length / 3 / 500));
  let sum = 0,
    many = 0;
  for (let f = 0; f < face.length; f += step, many++) {
    const i = 3 * face[f],
      j = 3 * face[f + 1];
    sum += Math.hypot(...[0, 1, 2].map((c) => position[i + c] - position[j + c]));
  }
  return sum / Math.max(many, 1) / 65535;
}

class Drawing {
  // arrays of one side: position, normal, color, confidence, place, match, face; vertex, where rows are not the file's;
  // look.* and own.*, its textures or colors. ramp: colors of confidence 0..1 in even steps.
  constructor(words, arrays, ramp) {
    this.words = words;
    this.arrays = arrays;
    this.scene = new THREE.Scene();
    this.geometry = geometryOf({
      position: [arrays.position, 3],
      normal: [arrays.normal, 3],
      tint: [arrays.color, 3],
      confidence: [arrays.confidence, 1],
    });
    if (!words.cloud) this.geometry.setIndex(new THREE.BufferAttribute(arrays.face, 1));
    this.uniforms = {
      mode: { value: 0 },
      points: { value: words.cloud },
      pointSize: { value: 1 },
      ramp: { value: ramp.map((color) => new THREE.Vector3(...color)) },
    };
    const material = new THREE.ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: this.uniforms,
      defines: { STEPS: ramp.length },
      side: THREE.DoubleSide,
      ...BEHIND_LINES,
    });
    this.body = this.put(
      words.cloud ? new THREE.Points(this.geometry, material) : new THREE.Mesh(this.geometry, material),
    );
    this.skins = {};
    this.picker = new Picker(arrays.position, arrays.face, words.size, words.radius);
    this.edge = words.cloud ? 0 : usualEdge(arrays.position, arrays.face) * words.size;
  }

  // Decode the images of its textures; everything else works without them.
  async dress(name) {
    const words = this.words[name];
    if (!words) return;
    const part = (key) => this.arrays[`${name}.${key}`];
    const images = await Promise.all(words.images.map((kind, k) => textureSource(part(`image${k}`), kind)));
    const vertex = part('vertex');
    const geometry = geometryOf({
      position: [rowsOf(this.arrays.position, vertex), 3],
      normal: [rowsOf(this.arrays.normal, vertex), 3],
      paint: [part('paint'), 3],
    });
    geometry.setAttribute('uv', new THREE.BufferAttribute(part('uv'), 2));
    geometry.setIndex(new THREE.BufferAttribute(part('face'), 1));
    const materials = words.groups.map((group, k) => {
      geometry.addGroup(group.start, group.count, k);
      return skinMaterial(group, images[group.image], Boolean(part('paint')));
    });
    this.skins[name] = this.put(new THREE.Mesh(geometry, materials));
    this.skins[name].visible = false;
  }

  put(object) {
    object.scale.setScalar(this.words.size);
    object.position.setScalar(-this.words.size / 2);
    object.frustumCulled = false;
    this.scene.add(object);
    return object;
  }

  show(mode) {
    const skin = this.skins[mode],
      paint = this.arrays[`${mode}.paint`];
    for (const other of Object.values(this.skins)) other.visible = other === skin;
    this.body.visible = !skin;
    this.uniforms.mode.value = MODES[mode];
    if (!skin && paint) this.geometry.setAttribute('paint', new THREE.BufferAttribute(paint, 3, true));
  }

  wireframe(wanted) {
    if (wanted && !this.lines && !this.words.cloud) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute('position', this.geometry.getAttribute('position'));
      geometry.setIndex(new THREE.BufferAttribute(uniqueEdges(this.arrays.face, this.picker.count), 1));
      geometry.boundingSphere = this.geometry.boundingSphere;
      const material = new THREE.ShaderMaterial({
        vertexShader: LINE_VERTEX,
        fragmentShader: LINE_FRAGMENT,
        uniforms: { strength: { value: 0.4 } },
        transparent: true,
        depthWrite: false,
      });
      this.lines = this.put(new THREE.LineSegments(geometry, material));
    }
    if (this.lines) this.lines.visible = wanted;
  }

  // `pixels` is the number of pixels of a panel per page unit at depth 1.
  render(renderer, camera, pixels) {
    this.uniforms.pointSize.value = 2 * this.words.radius * pixels * renderer.getPixelRatio();
    if (this.lines) {
      const seen = (this.edge * pixels) / camera.position.length(); // an edge in pixels: dense lines are fainter
      this.lines.material.uniforms.strength.value = Math.min(Math.max(0.05 * seen, 0.07), 0.4);
    }
    renderer.render(this.scene, camera);
  }

  vertexPlace(row) {
    return this.fromCube(this.arrays.position, row);
  }

  fromCube(array, row) {
    const at = (k) => (array[3 * row + k] / 65535 - 0.5) * this.words.size;
    return new THREE.Vector3(at(0), at(1), at(2));
  }

  // The file's index of a row, and the row of an index (-1 if it is not drawn).
  vertexOf(row) {
    return this.arrays.vertex ? this.arrays.vertex[row] : row;
  }

  rowOf(vertex) {
    if (!this.arrays.vertex) return vertex < this.picker.count ? vertex : -1;
    return this.arrays.vertex.indexOf(vertex);
  }
}

// Unique edges, as pairs of vertices for THREE.LineSegments; listed per lower vertex, so that searches are short.
function uniqueEdges(face, count) {
  const start = new Uint32Array(count + 1);
  const next = (h) => (h % 3 === 2 ? h - 2 : h + 1); // the corner after corner h of its triangle
  for (let h = 0; h < face.length; h++) start[Math.min(face[h], face[next(h)]) + 1]++;
  for (let i = 0; i < count; i++) start[i + 1] += start[i];
  const upper = new Uint32Array(face.length);
  const end = start.slice(0, count);
  let total = 0;
  for (let h = 0; h < face.length; h++) {
    const i = face[h];
    const j = face[next(h)];
    const low = i < j ? i : j;
    const high = i < j ? j : i;
    let k = start[low];
    while (k < end[low] && upper[k] !== high) k++;
    if (k === end[low]) {
      upper[end[low]++] = high;
      total++;
    }
  }
  const edges = new Uint32Array(2 * total);
  for (let i = 0, length = 0; i < count; i++)
    for (let k = start[i]; k < end[i]; k++) {
      edges[length++] = i;
      edges[length++] = upper[k];
    }
  return edges;
}
