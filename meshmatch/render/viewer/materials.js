// Shading of surfaces, and of textured ones.

const BEHIND_LINES = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
const WRAPS = {
  repeat: THREE.RepeatWrapping,
  clamp: THREE.ClampToEdgeWrapping,
  mirror: THREE.MirroredRepeatWrapping,
};

// `color` is linear; the result is gamma-encoded (2.2).
const LIGHT = `
  uniform bool points;
  varying vec3 vNormal, vEye;
  vec3 lit(vec3 color) {
    vec3 n = vNormal;
    if (dot(n, n) < 0.05) n = points ? -vEye : cross(dFdx(vEye), dFdy(vEye));
    n = normalize(n);
    vec3 toEye = normalize(-vEye);
    if (points ? dot(n, toEye) < 0.0 : !gl_FrontFacing) n = -n;
    float key = max(dot(n, normalize(vec3(-0.45, 0.65, 0.75))), 0.0);
    float fill = max(dot(n, normalize(vec3(0.8, 0.1, 0.45))), 0.0);
    float light = 0.30 + 0.14 * n.y + 0.62 * key + 0.16 * fill;
    light *= 0.78 + 0.22 * abs(dot(n, toEye));
    return pow(min(color * light, 1.0), vec3(1.0 / 2.2));
  }`;

const SKIN_VERTEX = `
  attribute vec3 paint;
  varying vec3 vPaint, vNormal, vEye;
  varying vec2 vUv;
  void main() {
    vec4 eye = modelViewMatrix * vec4(position, 1.0);
    vEye = eye.xyz;
    vNormal = normalMatrix * normal;
    vUv = uv;
    vPaint = paint;
    gl_Position = projectionMatrix * eye;
  }`;

const SKIN_FRAGMENT = `
  uniform sampler2D image;
  uniform bool pictured, painted;
  uniform vec4 factor;
  uniform float cutoff; // below it nothing is drawn
  uniform bool seeThrough;
  varying vec3 vPaint;
  varying vec2 vUv;
  ${LIGHT}
  void main() {
    vec4 texel = pictured ? texture2D(image, vUv) : vec4(1.0);
    float alpha = texel.a * factor.a;
    if (alpha < cutoff) discard;
    vec3 color = pow(texel.rgb, vec3(2.2)) * factor.rgb;
    if (painted) color *= pow(vPaint, vec3(2.2));
    gl_FragColor = vec4(lit(color), seeThrough ? alpha : 1.0);
  }`;

function textureSource(bytes, type) {
  const options = { premultiplyAlpha: 'none', colorSpaceConversion: 'none' };
  return createImageBitmap(new Blob([bytes], { type }), options);
}

function skinMaterial(group, image, painted) {
  const texture = new THREE.Texture(image ?? null);
  texture.flipY = false;
  [texture.wrapS, texture.wrapT] = group.wrap.map((name) => WRAPS[name]);
  if (group.nearest) texture.magFilter = THREE.NearestFilter;
  texture.anisotropy = 4;
  texture.needsUpdate = Boolean(image);
  const through = group.alpha === 'blend';
  return new THREE.ShaderMaterial({
    vertexShader: SKIN_VERTEX,
    fragmentShader: SKIN_FRAGMENT,
    uniforms: {
      points: { value: false },
      image: { value: texture },
      pictured: { value: Boolean(image) },
      painted: { value: painted },
      factor: { value: new THREE.Vector4(...group.factor) },
      cutoff: { value: { opaque: -1, mask: group.cutoff, blend: 0.02 }[group.alpha] },
      seeThrough: { value: through },
    },
    transparent: through,
    side: THREE.DoubleSide,
    ...BEHIND_LINES,
  });
}
