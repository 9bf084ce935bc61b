// Text and controls around the panels, and the keys.

// A name within a sentence, isolated from its writing direction.
const within = (name) => `\u2068${name}\u2069`;

// Parts of each legend: text, the scale, and what may be omitted where there is little room.
const SCALE = Symbol('scale');
const LEGENDS = {
  matches: () => ['One color is one place', ': the source by position, the target through the map.'],
  look: () => [
    `The ${words.look.kind} of ${within(words[words.look.side].name)}`,
    ', transferred by the map to the other.',
  ],
  own: () => ['Each shape as it is in its file', ''],
  confidence: () => {
    const [there, back] = words.confidence.map((value) => value.toFixed(2));
    return [
      '0',
      SCALE,
      '1',
      'confidence of each match',
      `: ${there} on average on the source, ${back} on the target.`,
    ];
  },
  plain: () => ['The shapes alone', ''],
};

function modes() {
  const found = [['matches', 'Matches']];
  if (words.look) found.push(['look', words.look.kind === 'texture' ? 'Texture' : 'Colors']);
  if (words.own) found.push(['own', 'Original']);
  if (words.confidence) found.push(['confidence', 'Confidence']);
  return [...found, ['plain', 'Plain']];
}

function setMode(mode) {
  state.mode = mode;
  for (const side of SIDES) drawings[side].show(mode);
  for (const input of $('modes').querySelectorAll('input')) input.checked = input.value === mode;
  const parts = LEGENDS[mode](),
    more = parts.pop();
  const last = spanOf('last', parts.pop());
  last.append(spanOf('more', more));
  $('legend').replaceChildren(
    ...parts.map((part) => (part === SCALE ? scaleOf(words.ramp) : spanOf('', part))),
    last,
  );
  soon();
}

function spanOf(className, text) {
  const element = document.createElement('span');
  element.className = className;
  element.textContent = text;
  return element;
}

function scaleOf(ramp) {
  const element = spanOf('scale', ''),
    written = (color) => `rgb(${color.map((part) => Math.round(255 * part)).join(' ')})`;
  element.style.background = `linear-gradient(90deg, ${ramp.map(written).join()})`;
  return element;
}

function setWireframe(wanted) {
  state.wireframe = wanted;
  for (const side of SIDES) drawings[side].wireframe(wanted);
  $('wireframe').setAttribute('aria-pressed', wanted);
  soon();
}

function setLinked(wanted) {
  state.linked = wanted;
  $('linked').setAttribute('aria-pressed', wanted);
  if (wanted) follow('source');
}

const MEANS = {
  good: 'The template lies well on both shapes.',
  fair: 'Most of it fits; look at the places named here.',
  poor: 'Do not trust this map without looking.',
  unknown: 'The map’s file does not say how good it is.',
};

function write() {
  const count = new Intl.NumberFormat('en');
  for (const side of SIDES) {
    const { name, vertices, note } = words[side];
    $(`title-${side}`).textContent = name;
    panel(side).querySelector('.name').textContent = name;
    const amount = panel(side).querySelector('.count');
    if (note) amount.textContent = note;
    else amount.replaceChildren(count.format(vertices), spanOf('more', ' vertices'));
    view(side).setAttribute(
      'aria-label',
      `${side} ${name}, ${count.format(vertices)} vertices, three-dimensional view`,
    );
    panel(side).querySelector('input').setAttribute('aria-label', `Vertex of the ${side}, ${name}`);
    if (note)
      $('help-notes').append(
        listed(`${within(name)} is ${note}. Every vertex drawn stands for one of the file.`),
      );
  }
  const verdict = words.verdict;
  $('verdict').dataset.verdict = verdict;
  $('verdict-word').textContent = verdict === 'unknown' ? 'no verdict' : `${verdict} fit`;
  $('verdict-means').textContent = MEANS[verdict];
  $('reasons').replaceChildren(...words.reasons.map(listed));
  $('help-map').textContent =
    `For each vertex of ${within(words.source.name)} the map knows its place on ${within(words.target.name)}, and the other way round. ` +
    'The ring marks that exact place, dashed where it is on the far side; the number is the vertex nearest to it.';
  $('made').textContent =
    `Made by meshmatch ${words.version}, drawn with three.js r${THREE.REVISION} (MIT licence).`;
  const list = modes();
  $('last-mode').textContent = list.length;
  list.forEach(([mode, label], k) => {
    const element = document.createElement('label'),
      input = document.createElement('input');
    const text = document.createElement('span');
    Object.assign(input, { type: 'radio', name: 'mode', value: mode });
    input.setAttribute('aria-keyshortcuts', k + 1);
    input.addEventListener('change', () => setMode(mode));
    text.textContent = label;
    element.append(input, text);
    $('modes').append(element);
  });
  $('wireframe').hidden = words.source.cloud && words.target.cloud;
}

function listed(text) {
  const element = document.createElement('li');
  element.textContent = text;
  return element;
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const typing = event.target instanceof HTMLInputElement && event.target.type !== 'radio';
  if (typing || $('help').open) return;
  const side = document.activeElement === view('target') ? 'target' : 'source';
  const radio = event.target instanceof HTMLInputElement; // arrows choose among the colors there
  const list = modes(),
    key = event.key;
  if (/^[1-9]$/.test(key) && Number(key) <= list.length) setMode(list[Number(key) - 1][0]);
  else if (key === 'w' || key === 'W') $('wireframe').hidden || setWireframe(!state.wireframe);
  else if (key === 'l' || key === 'L') setLinked(!state.linked);
  else if (key === 'r' || key === 'R') reset();
  else if (key === '?') $('help').showModal();
  else if (key === '+' || key === '=') zoomBy(side, 1 / 1.15);
  else if (key === '-') zoomBy(side, 1.15);
  else if (key === 'Escape' && $('verdict').open) $('verdict').open = false;
  else if (key === 'Escape') {
    state.hover = null;
    choose('pin', null);
    tell(true);
    soon();
  } else if (key.startsWith('Arrow') && !radio) {
    const step = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, 10], ArrowDown: [0, -10] }[key];
    turnBy(side, ...step);
  } else return;
  event.preventDefault();
}
