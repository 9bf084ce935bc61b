// Contents of the page: words as JSON, and arrays as zlib in base64.

function readWords() {
  return JSON.parse(document.getElementById('words').textContent);
}

// Return {name: typed array}; the text is released afterwards.
async function readArrays(table) {
  const element = document.getElementById('packed');
  const packed = fromBase64(element.textContent);
  element.remove();
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
  const bytes = await new Response(stream).arrayBuffer();
  const kinds = { Uint8Array, Int8Array, Uint16Array, Int16Array, Uint32Array, Float32Array };
  const arrays = {};
  for (const { name, kind, start, length } of table) arrays[name] = new kinds[kind](bytes, start, length);
  return arrays;
}

function fromBase64(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

const $ = (id) => document.getElementById(id);

// Open the page: write the words, prepare the drawing, then start.
async function openPage(words, { write, prepare, resize, reset, begin }) {
  try {
    write();
    if (typeof DecompressionStream === 'undefined')
      throw new Error('this browser is too old to unpack the page');
    const arrays = await readArrays(words.arrays);
    try {
      prepare(arrays);
    } catch (error) {
      throw new Error(`this browser does not draw in 3D (WebGL 2): ${error.message}`);
    }
    new ResizeObserver(resize).observe($('stage'));
    resize();
    reset();
    $('message').textContent = '';
    await begin();
  } catch (error) {
    $('message').textContent = `This page cannot be shown: ${error.message}.`;
    console.error(error);
  }
}
