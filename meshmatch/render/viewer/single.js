// One view of one shape: its camera, and the keys and the pointer that turn it. The page has `words` and draws a `frame`.

const VIEW = { turn: 20, tilt: 8, field: 28 }; // degrees
const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
let renderer,
  scene,
  camera,
  control,
  due = false;

function soon() {
  if (due) return;
  due = true;
  requestAnimationFrame((now) => {
    due = false;
    frame(now);
    control.update();
    renderer.render(scene, camera);
    document.documentElement.dataset.ready = '';
  });
}

// Camera position from which all of `words.extent` is visible.
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
  soon();
}

// Control by the arrow keys, plus and minus.
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

// A scene on the page's canvas with one body in it.
function openView(body) {
  const canvas = $('canvas');
  renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // the shader encodes colors itself
  camera = new THREE.PerspectiveCamera(VIEW.field, 1, 0.005, 50);
  scene = new THREE.Scene();
  body.frustumCulled = false;
  scene.add(body);
  control = new THREE.OrbitControls(camera, canvas);
  Object.assign(control, { enableDamping: !calm, dampingFactor: 0.18, minDistance: 0.03, maxDistance: 12 });
  control.addEventListener('change', soon);
}
