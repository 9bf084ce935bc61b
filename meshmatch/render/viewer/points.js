// Points and their matches: picking under the pointer, the marks over both panels, and their text.

function screenPlace(side, place) {
  const box = view(side).getBoundingClientRect();
  const seen = place.clone().applyMatrix4(cameras[side].matrixWorldInverse);
  const depth = -seen.z;
  seen.applyMatrix4(cameras[side].projectionMatrix);
  return { x: (0.5 + 0.5 * seen.x) * box.width, y: (0.5 - 0.5 * seen.y) * box.height, depth, box };
}

function pick(side, x, y) {
  const camera = cameras[side],
    box = view(side).getBoundingClientRect();
  camera.updateMatrixWorld();
  const matrix = new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
  const picker = drawings[side].picker;
  picker.look(matrix.elements, box.width, box.height, perUnit(side));
  return picker.at(x, y);
}

// Data of a point on one side and of its match on the other, for marks and text.
function match(point) {
  const own = drawings[point.side],
    other = drawings[OTHER[point.side]];
  const place = own.arrays.place;
  return {
    side: point.side,
    row: point.row,
    vertex: own.vertexOf(point.row),
    match: own.arrays.match[point.row],
    confidence: own.arrays.confidence[point.row] / 255,
    places: {
      [point.side]: own.vertexPlace(point.row),
      [OTHER[point.side]]: other.fromCube(place, point.row),
    },
  };
}

const current = () => state.hover ?? state.pin;

function mark() {
  const point = current(),
    found = point && match(point);
  const stage = $('stage').getBoundingClientRect();
  const ends = [];
  for (const side of SIDES) {
    const group = $(`mark-${side}`);
    if (!found) {
      group.style.visibility = 'hidden';
      continue;
    }
    const at = screenPlace(side, found.places[side]);
    const inside = at.depth > 0 && at.x >= 0 && at.y >= 0 && at.x <= at.box.width && at.y <= at.box.height;
    group.style.visibility = inside ? 'visible' : 'hidden';
    if (!inside) continue;
    const surface = pick(side, at.x, at.y);
    group.classList.toggle('behind', surface !== null && surface.depth < at.depth - 0.02 * words[side].size);
    const x = at.x + at.box.left - stage.left,
      y = at.y + at.box.top - stage.top;
    group.setAttribute('transform', `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
    ends.push([x, y]);
  }
  const thread = $('thread');
  thread.style.visibility = ends.length === 2 ? 'visible' : 'hidden';
  if (ends.length === 2) {
    const [[x1, y1], [x2, y2]] = ends,
      length = Math.hypot(x2 - x1, y2 - y1),
      gap = Math.min(9 / length, 0.5);
    const set = (name, value) => thread.setAttribute(name, value.toFixed(1));
    (set('x1', x1 + (x2 - x1) * gap), set('y1', y1 + (y2 - y1) * gap));
    (set('x2', x2 + (x1 - x2) * gap), set('y2', y2 + (y1 - y2) * gap));
  }
}

function tell(announce) {
  const point = current(),
    found = point && match(point);
  const status = $('status');
  if (found) {
    const [from, to] = [words[found.side].name, words[OTHER[found.side]].name];
    const confidence = words.confidence ? found.confidence.toFixed(2) : 'unknown';
    status.replaceChildren(
      'Confidence ',
      bold(confidence),
      ': vertex ',
      bold(found.vertex),
      ' of ',
      isolated(from),
      ' → vertex ',
      bold(found.match),
      ' of ',
      isolated(to),
    );
    if (announce) $('announce').textContent = status.textContent;
  } else {
    const coarse = matchMedia('(pointer: coarse)').matches;
    status.textContent = `${coarse ? 'Tap' : 'Point at'} either shape to see the matched place on the other.`;
  }
  for (const side of SIDES) {
    const input = panel(side).querySelector('input');
    if (document.activeElement === input && !announce) continue; // the user is typing
    input.value = found ? (side === found.side ? found.vertex : found.match) : '';
  }
}

function bold(text) {
  const element = document.createElement('b');
  element.textContent = text;
  return element;
}

function isolated(text) {
  const element = document.createElement('bdi');
  element.textContent = text;
  return element;
}

function choose(kind, point) {
  const before = state[kind];
  if (before?.side === point?.side && before?.row === point?.row) return;
  state[kind] = point;
  tell(kind === 'pin');
  soon();
}

function pointAt(side, event, reach = [[0, 0]]) {
  const box = view(side).getBoundingClientRect();
  for (const [dx, dy] of reach) {
    const hit = pick(side, event.clientX - box.left + dx, event.clientY - box.top + dy);
    if (hit) return { side, row: hit.vertex };
  }
  return null;
}

// Touch is less exact than a mouse: taps just outside the shape count.
const AROUND = [
  [0, 0],
  ...[8, 16].flatMap((r) => [
    [r, 0],
    [-r, 0],
    [0, r],
    [0, -r],
  ]),
];

function listen(side) {
  const element = view(side);
  let pressed = null,
    waiting = null;
  element.addEventListener('pointermove', (event) => {
    if (event.pointerType === 'touch' || event.buttons) return;
    if (!waiting)
      requestAnimationFrame(() => {
        if (waiting) choose('hover', pointAt(side, waiting));
        waiting = null;
      });
    waiting = event;
  });
  element.addEventListener('pointerleave', () => {
    waiting = null;
    choose('hover', null);
  });
  element.addEventListener('pointerdown', (event) => {
    pressed = event.isPrimary && event.button === 0 ? event : null;
    element.classList.add('turning');
    if (event.pointerType !== 'touch') choose('hover', null);
  });
  element.addEventListener('pointerup', (event) => {
    element.classList.remove('turning');
    const touch = event.pointerType === 'touch';
    if (!pressed || !event.isPrimary) return;
    const moved = Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY);
    if (moved < (touch ? 12 : 5)) choose('pin', pointAt(side, event, touch ? AROUND : undefined));
    pressed = null;
  });
  element.addEventListener('pointercancel', () => {
    element.classList.remove('turning');
    pressed = null;
  });
  const form = panel(side).querySelector('form'),
    input = form.querySelector('input');
  const go = () => {
    const text = input.value.trim();
    if (text === '') return choose('pin', null);
    const vertex = /^\d{1,9}$/.test(text) ? Number(text) : -1;
    const row = vertex < 0 ? -1 : drawings[side].rowOf(vertex);
    if (row >= 0) {
      state.hover = null;
      return choose('pin', { side, row });
    }
    const { vertices, name } = words[side];
    const known = vertex >= 0 && vertex < vertices;
    $('status').textContent = known
      ? `Vertex ${vertex} of ${within(name)} is not among those drawn here.`
      : `${within(name)} has the vertices 0 to ${vertices - 1}.`;
    $('announce').textContent = $('status').textContent;
  };
  form.addEventListener('submit', (event) => {
    event.preventDefault();
    go();
  });
  input.addEventListener('change', go);
  input.addEventListener('focus', () => input.select());
}
