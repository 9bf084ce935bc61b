// The page's state, and the two cameras: what a frame shows, and how the views turn, zoom and stay linked.

const SIDES = ['source', 'target'];
const OTHER = { source: 'target', target: 'source' };
const VIEW = { turn: 20, tilt: 8, field: 28 }; // degrees

const words = readWords();
const state = { mode: 'matches', wireframe: false, linked: true, hover: null, pin: null, frames: 0 };
const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
let drawings,
  cameras,
  controls,
  renderer,
  due = false,
  fitted = 0;

const panel = (side) => $(side);
const view = (side) => panel(side).querySelector('.view');

function soon() {
  if (due) return;
  due = true;
  requestAnimationFrame(frame);
}

function frame() {
  due = false;
  for (const side of SIDES) controls[side].update();
  const stage = $('stage').getBoundingClientRect();
  renderer.setScissorTest(false);
  renderer.clear();
  renderer.setScissorTest(true);
  for (const side of SIDES) {
    const box = view(side).getBoundingClientRect();
    const left = box.left - stage.left,
      bottom = stage.bottom - box.bottom;
    renderer.setViewport(left, bottom, box.width, box.height);
    renderer.setScissor(left, bottom, box.width, box.height);
    drawings[side].render(renderer, cameras[side], perUnit(side));
  }
  mark();
  state.frames++;
  document.documentElement.dataset.ready = '';
}

// Pixels per page unit at depth 1.
function perUnit(side) {
  return view(side).clientHeight / 2 / Math.tan((VIEW.field * Math.PI) / 360);
}

function resize() {
  const stage = $('stage').getBoundingClientRect();
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setSize(stage.width, stage.height, false);
  const before = fitted;
  fitted = fittingDistance();
  for (const side of SIDES) {
    const camera = cameras[side];
    const width = view(side).clientWidth,
      height = Math.max(view(side).clientHeight, 1),
      [top, bottom] = covered(side);
    camera.aspect = width / height;
    camera.setViewOffset(width, height, 0, (bottom - top) / 2, width, height);
    if (before && isFinite(fitted / before)) {
      const target = controls[side].target;
      camera.position
        .sub(target)
        .multiplyScalar(fitted / before)
        .add(target);
    }
  }
  soon();
}

// Pixels of a panel that text covers, at the top and at the bottom.
function covered(side) {
  const box = view(side).getBoundingClientRect();
  const spot = panel(side).querySelector('.spot').getBoundingClientRect();
  const caption = panel(side).querySelector('.caption').getBoundingClientRect();
  return [caption.bottom - box.top, spot.top > box.top + box.height / 2 ? box.bottom - spot.top : 8];
}

// Camera positions from which both shapes fill their panels.
function fittingDistance() {
  const turn = (VIEW.turn * Math.PI) / 180,
    half = Math.tan((VIEW.field * Math.PI) / 360);
  let distance = 0;
  for (const side of SIDES) {
    const [w, h, d] = words[side].extent,
      box = view(side);
    const width = w * Math.cos(turn) + d * Math.sin(turn),
      aspect = box.clientWidth / Math.max(box.clientHeight, 1);
    const [top, bottom] = covered(side),
      height = Math.max(box.clientHeight, 1);
    const room = Math.max(height - top - bottom - 16, 40) / height;
    // When rotated, any corner may come to the front, where it is nearer and thus larger.
    const front = Math.hypot(w, d) / 2;
    distance = Math.max(distance, h / 2 / half / room + front, (width / 2 / half / aspect) * 1.1 + d / 2);
  }
  return distance;
}

function reset() {
  fitted = fittingDistance();
  const [turn, tilt] = [VIEW.turn, VIEW.tilt].map((degrees) => (degrees * Math.PI) / 180);
  for (const side of SIDES) {
    controls[side].enableDamping = false; // stops a movement that is still damped
    controls[side].update();
    controls[side].enableDamping = !calm;
  }
  for (const side of SIDES) {
    controls[side].target.set(0, 0, 0);
    cameras[side].position
      .set(-Math.sin(turn) * Math.cos(tilt), Math.sin(tilt), Math.cos(turn) * Math.cos(tilt))
      .multiplyScalar(fitted);
    cameras[side].lookAt(0, 0, 0);
  }
  soon();
}

function follow(side) {
  if (state.linked) {
    const own = cameras[side],
      other = cameras[OTHER[side]];
    other.position.copy(own.position);
    other.quaternion.copy(own.quaternion);
    controls[OTHER[side]].target.copy(controls[side].target);
  }
  soon();
}

function turnBy(side, right, up) {
  const camera = cameras[side],
    target = controls[side].target;
  const polar = new THREE.Spherical().setFromVector3(camera.position.clone().sub(target));
  polar.theta -= (right * Math.PI) / 180;
  polar.phi -= (up * Math.PI) / 180;
  camera.position.setFromSpherical(polar.makeSafe()).add(target);
  camera.lookAt(target);
  follow(side);
}

function zoomBy(side, factor) {
  const camera = cameras[side],
    target = controls[side].target;
  camera.position.sub(target).multiplyScalar(factor).add(target);
  follow(side);
}
