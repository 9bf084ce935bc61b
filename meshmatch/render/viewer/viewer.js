// Start of the page.

function prepare(arrays) {
  const canvas = $('canvas');
  renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  renderer.autoClear = false;
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // the shader encodes colors itself
  ((drawings = {}), (cameras = {}), (controls = {}));
  for (const side of SIDES) {
    const own = {};
    for (const [name, array] of Object.entries(arrays))
      if (name.startsWith(`${side}.`)) own[name.slice(side.length + 1)] = array;
    drawings[side] = new Drawing(words[side], own, words.ramp);
    cameras[side] = new THREE.PerspectiveCamera(VIEW.field, 1, 0.005, 50);
    const control = (controls[side] = new THREE.OrbitControls(cameras[side], view(side)));
    Object.assign(control, { enableDamping: !calm, dampingFactor: 0.18, minDistance: 0.03, maxDistance: 12 });
    control.addEventListener('change', () => follow(side));
    listen(side);
  }
}

async function dress() {
  for (const side of SIDES) for (const name of ['look', 'own']) await drawings[side].dress(name);
  setMode(state.mode);
}

async function begin() {
  setMode('matches');
  tell();
  $('wireframe').addEventListener('click', () => setWireframe(!state.wireframe));
  $('linked').addEventListener('click', () => setLinked(!state.linked));
  $('reset').addEventListener('click', reset);
  $('ask').addEventListener('click', () => $('help').showModal());
  document.addEventListener('keydown', keys);
  document.addEventListener('pointerdown', (event) => {
    if (!$('verdict').contains(event.target)) $('verdict').open = false;
  });
  await dress();
}

// For tests, and for use in the browser's console.
window.meshmatch = {
  state: () => {
    const point = current(),
      found = point && match(point);
    const { places, ...rest } = found ?? {};
    return { ...state, shown: found ? rest : null };
  },
  // Screen position of a vertex, and whether it is unoccluded.
  project: (side, vertex) => {
    cameras[side].updateMatrixWorld();
    const at = screenPlace(side, drawings[side].vertexPlace(drawings[side].rowOf(vertex)));
    const surface = pick(side, at.x, at.y);
    const seen = surface !== null && surface.depth > at.depth - 0.01 * words[side].size;
    return { x: at.x + at.box.left, y: at.y + at.box.top, seen };
  },
};

openPage(words, { write, prepare, resize, reset, begin });
