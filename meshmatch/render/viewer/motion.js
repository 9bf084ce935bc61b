// A shape in motion: vertices are interpolated linearly between frames.

const SECONDS = 4; // from the first frame to the last
const words = readWords();
const state = { time: words.times[0], playing: false, frames: 0 };
let geometry,
  uniforms,
  places,
  normals,
  before = 0,
  ahead = 1;

const VERTEX = `
  attribute vec3 paint, nextPosition, nextNormal;
  uniform float share, pointSize;
  varying vec3 vPaint, vNormal, vEye;
  void main() {
    vec4 eye = modelViewMatrix * vec4(mix(position, nextPosition, share), 1.0);
    vEye = eye.xyz;
    vNormal = normalMatrix * mix(normal, nextNormal, share);
    vPaint = paint;
    gl_Position = projectionMatrix * eye;
    gl_PointSize = max(pointSize / -eye.z, 1.5);
  }`;

const FRAGMENT = `
  varying vec3 vPaint;
  ${LIGHT}
  void main() {
    if (points) {
      vec2 disc = 2.0 * gl_PointCoord - 1.0;
      if (dot(disc, disc) > 1.0) discard;
    }
    gl_FragColor = vec4(lit(pow(vPaint, vec3(2.2))), 1.0);
  }`;

// The frame before a time, and the fraction of the way to the next one.
function between(time) {
  const { times } = words;
  let k = 0;
  while (k < times.length - 2 && times[k + 1] <= time) k++;
  return [k, Math.min(Math.max((time - times[k]) / (times[k + 1] - times[k]), 0), 1)];
}

function frame(now) {
  if (state.playing) {
    const { times } = words,
      first = times[0],
      last = times[times.length - 1];
    let time = state.time + (before ? (ahead * (now - before) * (last - first)) / 1000 / SECONDS : 0);
    if (time >= last) [time, ahead] = [last, -1];
    if (time <= first) [time, ahead] = [first, 1];
    before = now;
    show(time);
    soon();
  }
  const rows = renderer.domElement.height; // pixels of the screen
  uniforms.pointSize.value = (words.radius * rows) / Math.tan((VIEW.field * Math.PI) / 360);
  state.frames++;
}

function show(time) {
  state.time = time;
  const [k, share] = between(time);
  geometry.setAttribute('position', places[k]);
  geometry.setAttribute('nextPosition', places[k + 1]);
  geometry.setAttribute('normal', normals[k]);
  geometry.setAttribute('nextNormal', normals[k + 1]);
  uniforms.share.value = share;
  $('time').value = time;
  $('now').textContent = time.toFixed(2);
  soon();
}

function play(wanted) {
  state.playing = wanted;
  before = 0;
  $('play').setAttribute('aria-pressed', wanted);
  $('play').textContent = wanted ? 'Stop' : 'Play';
  soon();
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.toLowerCase();
  if (key === 'k') play(!state.playing);
  else if (key === 'r') reset();
  else if (event.target === $('canvas')) return turn(event);
}

function prepare(arrays) {
  geometry = new THREE.BufferGeometry();
  const many = words.times.length;
  const split = (array) => {
    const size = array.length / many;
    return Array.from({ length: many }, (_, k) => {
      return new THREE.BufferAttribute(array.subarray(k * size, (k + 1) * size), 3, true);
    });
  };
  [places, normals] = [split(arrays.position), split(arrays.normal)];
  geometry.setAttribute('paint', new THREE.BufferAttribute(arrays.color, 3, true));
  if (!words.cloud) geometry.setIndex(new THREE.BufferAttribute(arrays.face, 1));
  uniforms = { share: { value: 0 }, pointSize: { value: 1 }, points: { value: words.cloud } };
  const material = new THREE.ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms,
    side: THREE.DoubleSide,
  });
  const body = words.cloud ? new THREE.Points(geometry, material) : new THREE.Mesh(geometry, material);
  body.position.set(...words.low); // the cube's corner; its edge is 1
  openView(body);
}

// Names of the shapes that the motion passes, above the slider.
function write() {
  const { times, met } = words,
    first = times[0],
    last = times[times.length - 1];
  $('title').textContent = words.title;
  $('count').textContent = words.note;
  Object.assign($('time'), { min: first, max: last });
  for (const [time, name] of met) {
    const share = (time - first) / (last - first);
    const span = document.createElement('span');
    span.textContent = name;
    if (share < 0.02) span.className = 'first';
    if (share > 0.98) span.className = 'last';
    span.style.left = `${100 * share}%`;
    $('names').append(span);
  }
}

async function begin() {
  show(words.times[0]);
  $('time').addEventListener('input', () => {
    play(false);
    show(Number($('time').value));
  });
  $('play').addEventListener('click', () => play(!state.playing));
  $('reset').addEventListener('click', reset);
  document.addEventListener('keydown', keys);
}

// For tests, and for use in the browser's console.
window.meshmatch = {
  state: () => ({ ...state, between: between(state.time) }),
  show,
};

openPage(words, { write, prepare, resize, reset, begin });
