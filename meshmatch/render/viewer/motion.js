// A shape that moves: between two of its frames every vertex goes straight from one to the next.

const VIEW = { turn: 20, tilt: 8, field: 28 }; // degrees
const SECONDS = 4; // from the first frame to the last
const words = readWords();
const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
const state = { time: words.times[0], playing: false, frames: 0 };
let renderer,
  scene,
  camera,
  control,
  geometry,
  uniforms,
  places,
  normals,
  due = false,
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

// The frame before a time, and how far it is to the next one.
function between(time) {
  const { times } = words;
  let k = 0;
  while (k < times.length - 2 && times[k + 1] <= time) k++;
  return [k, Math.min(Math.max((time - times[k]) / (times[k + 1] - times[k]), 0), 1)];
}

function soon() {
  if (due) return;
  due = true;
  requestAnimationFrame(frame);
}

function frame(now) {
  due = false;
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
  control.update();
  renderer.render(scene, camera);
  state.frames++;
  document.documentElement.dataset.ready = '';
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

function reset() {
  const [turn, tilt, half] = [VIEW.turn, VIEW.tilt, VIEW.field / 2].map((degrees) => (degrees * Math.PI) / 180);
  const [w, h, d] = words.extent;
  const width = w * Math.cos(turn) + d * Math.sin(turn);
  const distance = Math.max(h / 2, width / 2 / camera.aspect) / Math.tan(half) / 0.88 + d / 2;
  control.target.set(0, 0, 0);
  camera.position
    .set(-Math.sin(turn) * Math.cos(tilt), Math.sin(tilt), Math.cos(turn) * Math.cos(tilt))
    .multiplyScalar(distance);
  camera.lookAt(0, 0, 0);
  soon();
}

function resize() {
  const { clientWidth: width, clientHeight: height } = $('stage');
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setSize(width, height, false);
  camera.aspect = width / Math.max(height, 1);
  camera.updateProjectionMatrix();
  uniforms.pointSize.value = (words.radius * height * renderer.getPixelRatio()) / Math.tan((VIEW.field * Math.PI) / 360);
  soon();
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.toLowerCase();
  if (key === 'k') play(!state.playing);
  else if (key === 'r') reset();
  else if (event.target === $('canvas')) return turn(event);
}

function turn(event) {
  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const polar = new THREE.Spherical().setFromVector3(camera.position.clone().sub(control.target));
  if (event.key in steps) {
    polar.theta -= (8 * steps[event.key][0] * Math.PI) / 180;
    polar.phi -= (8 * steps[event.key][1] * Math.PI) / 180;
  } else if (event.key === '+' || event.key === '=') polar.radius /= 1.15;
  else if (event.key === '-') polar.radius *= 1.15;
  else return;
  event.preventDefault();
  camera.position.setFromSpherical(polar.makeSafe()).add(control.target);
  camera.lookAt(control.target);
  soon();
}

function prepare(arrays) {
  const canvas = $('canvas');
  renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // the shader writes colors as they are to appear
  camera = new THREE.PerspectiveCamera(VIEW.field, 1, 0.005, 50);
  scene = new THREE.Scene();
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
  body.frustumCulled = false;
  body.position.set(...words.low); // the cube's corner; its edge is 1
  scene.add(body);
  control = new THREE.OrbitControls(camera, canvas);
  Object.assign(control, { enableDamping: !calm, dampingFactor: 0.18, minDistance: 0.03, maxDistance: 12 });
  control.addEventListener('change', soon);
}

// Names of the shapes that are met, above the slider.
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

// For tests, and for the curious at the console.
window.meshmatch = {
  state: () => ({ ...state, between: between(state.time) }),
  show,
};

openPage(words, { write, prepare, resize, reset, begin });
