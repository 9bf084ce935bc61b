// A mean shape and its modes: each slider adds standard deviations of one mode.

const REACH = 3; // range of the sliders, in standard deviations
const SECONDS = 4; // for a mode to play there and back
const SWING = 2; // amplitude in standard deviations when a mode plays
const words = readWords();
const state = { scores: words.shares.map(() => 0), shape: -1, mode: 0, playing: false, colored: true, frames: 0 };
let geometry, arrays, mean, place, normal, paint;
let began = 0,
  farthest = 0;

const VERTEX = `
  attribute vec3 paint;
  varying vec3 vPaint, vNormal, vEye;
  void main() {
    vec4 eye = modelViewMatrix * vec4(position, 1.0);
    vEye = eye.xyz;
    vNormal = normalMatrix * normal;
    vPaint = paint;
    gl_Position = projectionMatrix * eye;
  }`;

const FRAGMENT = `
  varying vec3 vPaint;
  ${LIGHT}
  void main() {
    gl_FragColor = vec4(lit(pow(vPaint, vec3(2.2))), 1.0);
  }`;

function frame(now) {
  if (state.playing) {
    began ||= now;
    state.scores[state.mode] = SWING * Math.sin((2 * Math.PI * (now - began)) / 1000 / SECONDS);
    show();
  }
  state.frames++;
}

// The shape with the scores of `state`.
function show() {
  place.set(mean);
  state.scores.forEach((score, m) => {
    const factor = (score * words.reach[m]) / 32767,
      start = m * mean.length;
    if (factor) for (let i = 0; i < mean.length; i++) place[i] += factor * arrays.mode[start + i];
  });
  color();
  shade();
  for (const name of ['position', 'normal', 'paint']) geometry.getAttribute(name).needsUpdate = true;
  write();
  soon();
}

function color() {
  const { ramp, clay, unit, far } = words,
    last = ramp.length - 1;
  farthest = 0;
  for (let i = 0; i < mean.length; i += 3) {
    const apart = unit * Math.hypot(place[i] - mean[i], place[i + 1] - mean[i + 1], place[i + 2] - mean[i + 2]);
    farthest = Math.max(farthest, apart);
    const at = Math.min(Math.max(apart / far, 0), 1) * last,
      k = Math.min(Math.floor(at), last - 1);
    for (let c = 0; c < 3; c++) {
      paint[i + c] = state.colored ? ramp[k][c] + (at - k) * (ramp[k + 1][c] - ramp[k][c]) : clay[c];
    }
  }
}

// Area-weighted vertex normals.
function shade() {
  const { face } = arrays;
  normal.fill(0);
  for (let f = 0; f < face.length; f += 3) {
    const [a, b, c] = [3 * face[f], 3 * face[f + 1], 3 * face[f + 2]];
    const [ux, uy, uz] = [place[b] - place[a], place[b + 1] - place[a + 1], place[b + 2] - place[a + 2]];
    const [vx, vy, vz] = [place[c] - place[a], place[c + 1] - place[a + 1], place[c + 2] - place[a + 2]];
    const [x, y, z] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const i of [a, b, c]) {
      normal[i] += x;
      normal[i + 1] += y;
      normal[i + 2] += z;
    }
  }
  for (let i = 0; i < normal.length; i += 3) {
    const length = Math.hypot(normal[i], normal[i + 1], normal[i + 2]) || 1;
    for (let c = 0; c < 3; c++) normal[i + c] /= length;
  }
}

function choose(shape) {
  const M = state.scores.length;
  state.shape = shape;
  state.scores = state.scores.map((_, m) => (shape < 0 ? 0 : arrays.score[shape * M + m]));
  $('shape').value = shape;
  play(false);
  show();
}

function setScore(mode, score) {
  state.scores[mode] = score;
  state.mode = mode;
  own();
  play(false);
  show();
}

// Deselect the shape of the collection.
function own() {
  state.shape = -2;
  $('shape').value = -2;
}

function random() {
  const normal = () => Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
  state.scores = state.scores.map(normal);
  own();
  play(false);
  show();
}

function play(wanted) {
  state.playing = wanted;
  began = 0;
  if (wanted) own();
  $('play').setAttribute('aria-pressed', wanted);
  $('play').textContent = wanted ? 'Stop' : `Play mode ${state.mode + 1}`;
  soon();
}

function setColored(wanted) {
  state.colored = wanted;
  $('colors').setAttribute('aria-pressed', wanted);
  $('legend').classList.toggle('off', !wanted);
  show();
}

// Show the values of the sliders.
function write() {
  state.scores.forEach((score, m) => {
    const text = `${score < 0 ? '−' : ''}${Math.abs(score).toFixed(2)} sd`,
      input = $(`mode-${m}`);
    input.value = score;
    input.setAttribute('aria-valuetext', text);
    $(`score-${m}`).textContent = text;
  });
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target === $('shape') || $('large').open) return;
  const key = event.key.toLowerCase();
  if (key === 'k') play(!state.playing);
  else if (key === 'm') choose(-1);
  else if (key === 'n') random();
  else if (key === 'c') setColored(!state.colored);
  else if (key === 'r') reset();
  else if (event.target === $('canvas')) turn(event);
}

function element(name, about, ...inside) {
  const found = Object.assign(document.createElement(name), about);
  found.append(...inside);
  return found;
}

function introduce() {
  $('title').textContent = words.title;
  $('count').textContent = words.note;
  $('kept').textContent = words.kept;
  $('high').textContent = words.high;
  const written = (color) => `rgb(${color.map((part) => Math.round(255 * part)).join(' ')})`;
  $('scale').style.background = `linear-gradient(90deg, ${words.ramp.map(written).join()})`;
  $('shape').append(
    element('option', { value: -1 }, 'the mean'),
    ...words.names.map((name, k) => element('option', { value: k }, name)),
    element('option', { value: -2, disabled: true }, 'by the sliders'),
  );
  $('shape').value = -1;
  $('modes').append(
    ...words.shares.map((share, m) => {
      const id = `mode-${m}`;
      const about = { type: 'range', id, min: -REACH, max: REACH, step: 'any', value: 0 };
      const input = element('input', about);
      input.addEventListener('input', () => setScore(m, Number(input.value)));
      const label = element('label', { htmlFor: id }, `Mode ${m + 1} `);
      label.append(element('span', { className: 'share' }, `${(100 * share).toFixed(1)} % of the variance`));
      const output = element('output', { id: `score-${m}`, htmlFor: id }, '0.00 sd');
      return element('div', { className: 'mode' }, label, output, input);
    }),
  );
}

function showFigures() {
  for (const [name, address] of words.figures) {
    const image = element('img', { src: address, alt: name });
    const button = element('button', { type: 'button', title: `${name}, larger` }, image, name);
    button.addEventListener('click', () => {
      Object.assign($('picture'), { src: address, alt: name });
      $('large').showModal();
    });
    $('figures').append(button);
  }
}

function prepare(found) {
  arrays = found;
  mean = Float32Array.from(arrays.position, (value, i) => value / 65535 + words.low[i % 3]);
  [place, normal, paint] = [mean, mean, mean].map((array) => new Float32Array(array.length));
  geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(place, 3));
  geometry.setAttribute('normal', new THREE.BufferAttribute(normal, 3));
  geometry.setAttribute('paint', new THREE.BufferAttribute(paint, 3));
  geometry.setIndex(new THREE.BufferAttribute(arrays.face, 1));
  const material = new THREE.ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms: { points: { value: false } },
    side: THREE.DoubleSide,
  });
  openView(new THREE.Mesh(geometry, material));
}

async function begin() {
  show();
  showFigures();
  $('shape').addEventListener('change', () => choose(Number($('shape').value)));
  $('mean').addEventListener('click', () => choose(-1));
  $('random').addEventListener('click', random);
  $('play').addEventListener('click', () => play(!state.playing));
  $('colors').addEventListener('click', () => setColored(!state.colored));
  $('reset').addEventListener('click', reset);
  document.addEventListener('keydown', keys);
}

// For tests, and for use in the browser's console.
window.meshmatch = {
  state: () => ({ ...state, farthest }),
  place: (vertex) => [...place.subarray(3 * vertex, 3 * vertex + 3)].map((at) => at * words.unit),
  normal: (vertex) => [...normal.subarray(3 * vertex, 3 * vertex + 3)],
  setScore,
  choose,
};

openPage(words, { write: introduce, prepare, resize, reset, begin });
