// The page's own part: unpacks viewer and scenes, starts a viewer for each scene, and holds two of them to one camera
// with a divider between. `window.g2ard.ready` resolves to the viewers' handles once all of them have drawn.

const read = id => document.getElementById(id).textContent;

function bytes(base64) {
  const packed = atob(base64);
  const out = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; i++) out[i] = packed.charCodeAt(i);
  return out;
}

async function module(base64) {
  const code = new Blob([bytes(base64)]).stream().pipeThrough(new DecompressionStream('gzip'));
  const text = await new Response(code).text();
  return import(URL.createObjectURL(new Blob([text], { type: 'text/javascript' })));
}

const { start, stops, background, files, antialiased, placed } = JSON.parse(read('view'));

// The viewer's field of view is along the window's longer side.
function fitted({ position, target, fov }) {
  const aspect = innerWidth / innerHeight;
  const half = halfHeight(fov, aspect) * Math.max(1, aspect);
  return { position, target, fov: Math.min(120, Math.max(10, Math.atan(half) * 360 / Math.PI)) };
}

document.body.classList.toggle('soft', background === null);

const settings = {
  version: 2,
  tonemapping: 'none',
  highPrecisionRendering: false,
  background: { color: background ?? [0, 0, 0, 0] }, // clear to see the page's gradient
  postEffectSettings: {
    sharpness: { enabled: false, amount: 0 },
    bloom: { enabled: false, intensity: 1, blurLevel: 2 },
    grading: { enabled: false, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
    vignette: { enabled: false, intensity: 0.5, inner: 0.3, outer: 0.75, curvature: 1 },
    fringing: { enabled: false, intensity: 0.5 }
  },
  animTracks: [],
  cameras: start ? [{ initial: fitted(start) }] : [],
  annotations: stops.map(({ title, ...view }) => ({
    title, text: '', position: view.target, extras: {}, camera: { initial: fitted(view) }
  })),
  startMode: 'default'
};

// Gaussians are drawn as they were trained, where the engine's own rules differ: blurred by 0.3 px², not 0.075; out to
// where α = 1/255, not to √8 σ with lower tails; ordered by depth, not distance; α at most 0.99. The blur is put on the
// scales, as 3 axes of the width that it has at the Gaussian's depth. GROWN is the factor on variances that makes the
// engine's quads, of √8 σ, reach as far as α = 1/255 of an opaque Gaussian does. In antialiased scenes α is multiplied
// by the square root of the ratio of the footprint's determinants without and with the blur; a footprint's determinant
// is proportional to dᵀ·adj(Σ)·d, d the direction of the view.
const GROWN = Math.log(255) / 4;

function asTrained(gsplat, mip) {
  gsplat.radialSorting = false;
  gsplat.minPixelSize = 0;
  gsplat.minContribution = 0;
  const chunks = gsplat.material.getShaderChunks('glsl');
  chunks.set('gsplatModifyVS', `
    float pixelVariance(vec3 center);
    float footprint(vec3 center, vec4 rotation, vec3 variances);
    float mipFactor = 1.0;
    void modifySplatCenter(inout vec3 center) {}
    void modifySplatRotationScale(vec3 original, vec3 center, inout vec4 rotation, inout vec3 scale) {
      ${mip ? `
      vec3 variances = scale * scale / pixelVariance(center);
      mipFactor = sqrt(footprint(center, rotation, variances) / footprint(center, rotation, variances + 0.3));
      ` : ''}
      scale = sqrt(${GROWN} * scale * scale + (0.3 * ${GROWN} - 0.075) * pixelVariance(center));
    }
    void modifySplatColor(vec3 center, inout vec4 color) { color.a *= mipFactor; }
  `);
  chunks.set('gsplatOutputVS', `
    float pixelVariance(vec3 center) {
      float depth = (matrix_view * matrix_model * vec4(center, 1.0)).z;
      float size = 2.0 * depth / (viewport_size.x * matrix_projection[0][0]);
      return size * size;
    }
    float footprint(vec3 center, vec4 rotation, vec3 variances) {
      mat4 modelView = matrix_view * matrix_model;
      vec3 d = normalize(transpose(mat3(modelView)) * (modelView * vec4(center, 1.0)).xyz);
      vec3 t = 2.0 * cross(d, rotation.xyz);
      d += rotation.w * t + cross(t, rotation.xyz);
      return dot(d * d, variances.yxx * variances.zzy);
    }
    vec3 prepareOutputFromGamma(vec3 color, float depth) { return color; }
  `);
  chunks.set('gsplatModifyPS', `
    void modifySplatColor(vec2 uv, inout vec4 color) {
      float alpha = gaussianColor.a * exp(-4.0 * ${GROWN} * dot(uv, uv));
      color.a = alpha < 1.0 / 255.0 ? 0.0 : min(alpha, 0.99);
    }
  `);
  gsplat.material.update();
}

// The engine drops a request to sort that comes while a sort is under way, and a camera that rests before it ends would
// keep the order of where it was: the request is made again when the sort ends. What was dropped before a sorter is
// first seen is not known, so that it sorts once more.
function sortToTheEnd(app) {
  const dropped = new Map();
  const look = () => {
    for (const { layersMap } of app.renderer.gsplatDirector.camerasMap.values()) {
      for (const { gsplatManager: manager } of layersMap.values()) {
        const sorter = manager?.cpuSorter;
        if (!sorter) continue;
        if (!dropped.has(sorter)) {
          const send = sorter.setSortParams;
          sorter.setSortParams = (...request) => {
            dropped.set(sorter, sorter.jobsInFlight > 0 && !sorter.hasNewVersion);
            send.apply(sorter, request);
          };
          dropped.set(sorter, true);
        }
        if (!dropped.get(sorter)) continue;
        manager.sortNeeded = true;
        app.renderNextFrame = true;
      }
    }
  };
  app.scene.on('gsplat:sorted', look);
  look();
}

// The viewer resolves names against the page's address, which fails in about:srcdoc, the address of notebooks' frames:
// embedded scenes, which nothing fetches, get whole addresses.
function content(index) {
  if (!document.getElementById(`scene${index}`)) return { contentUrl: files[index] }; // streamed from beside the page
  return {
    contentUrl: `https://embedded.invalid/${files[index]}`,
    contents: Promise.resolve(new Response(bytes(read(`scene${index}`))))
  };
}

async function viewer(createViewer, index, container) {
  const handle = await createViewer({
    container,
    settings,
    ...content(index),
    renderer: 'webgl',
    ui: index === 0,
    noanim: true
  });
  if (placed) { // streamed files keep the scene's axes
    handle.app.root.on('childinsert', node => {
      if (node.name !== 'gsplat') return;
      node.setLocalRotation(...placed.rotation);
      node.setLocalPosition(...placed.position);
    });
  }
  asTrained(handle.app.scene.gsplat, antialiased[index]);
  sortToTheEnd(handle.app);
  const drawn = new Promise(resolve => {
    if (handle.state.loaded) resolve();
    else handle.events.once('loaded:changed', resolve);
  });
  return { handle, drawn };
}

// The second viewer shows what the first one's camera sees. Its own camera is set on every frame before ours is.
function follow(leader, follower) {
  follower.state.inputEnabled = false;
  const [from, to] = [leader, follower].map(handle => handle.app.root.findByName('camera'));
  follower.app.on('update', () => {
    to.setPosition(from.getPosition());
    to.setRotation(from.getRotation());
    to.camera.fov = from.camera.fov;
    to.camera.horizontalFov = from.camera.horizontalFov;
    const scene = follower.app.root.findByName('gsplat');
    if (!scene) return;
    const bound = scene.gsplat.customAabb;
    const center = scene.getWorldTransform().transformPoint(bound.center);
    const far = Math.max(from.camera.farClip, center.distance(from.getPosition()) + bound.halfExtents.length());
    to.camera.farClip = far;
    to.camera.nearClip = Math.min(1, far / (1024 * 16));
  });
  leader.events.on('performanceMode:changed', on => { follower.state.performanceMode = on; });
}

// The divider: a handle to drag, or to move with the arrow keys while it has the focus.
function divide(right, leader) {
  const divider = document.getElementById('divider');
  divider.hidden = false;
  const place = share => {
    const percent = 100 * Math.min(1, Math.max(0, share));
    right.style.clipPath = `inset(0 0 0 ${percent}%)`;
    divider.style.left = `${percent}%`;
    divider.setAttribute('aria-valuenow', percent.toFixed(0));
  };
  divider.addEventListener('pointerdown', event => divider.setPointerCapture(event.pointerId));
  divider.addEventListener('pointermove', event => {
    if (divider.hasPointerCapture(event.pointerId)) place(event.clientX / innerWidth);
  });
  divider.addEventListener('keydown', event => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
    if (step === undefined) return;
    place(parseFloat(divider.style.left) / 100 + step);
    event.preventDefault();
  });
  divider.addEventListener('focus', () => { leader.state.inputEnabled = false; });
  divider.addEventListener('blur', () => { leader.state.inputEnabled = true; });
  // A label shows its scene alone, and both again.
  const labels = [...document.querySelectorAll('button.label')];
  labels.forEach((label, index) => label.addEventListener('click', () => {
    const alone = label.getAttribute('aria-pressed') !== 'true';
    labels.forEach(other => other.setAttribute('aria-pressed', other === label && alone));
    divider.hidden = alone;
    place(alone ? 1 - index : 0.5);
  }));
  place(0.5);
}

// Tab leads to the controls, which the viewer hides after some seconds, and to its switches, which are no buttons.
function reachByTab({ events }) {
  addEventListener('keydown', event => {
    if (event.key === 'Tab') events.fire('inputEvent', 'interact');
  }, true);
  for (const control of document.querySelectorAll('.sse-toggleSwitch')) {
    control.tabIndex = 0;
    control.role = 'button';
    control.ariaLabel = control.previousElementSibling.textContent;
    control.addEventListener('keydown', event => {
      if (event.key !== 'Enter' && event.key !== ' ') return;
      event.preventDefault();
      control.click();
    });
  }
}

async function main() {
  if (placed && location.protocol === 'file:') {
    throw new Error('its levels are loaded over http. Run "python -m http.server" in their folder and open '
      + 'http://localhost:8000');
  }
  try { // the list of controls is closed, unless it was opened in this browser
    localStorage.setItem('controlsPanelOpen', localStorage.getItem('controlsPanelOpen') ?? 'false');
  } catch { /* storage can be denied; the list is open then */ }
  const { createViewer } = await module(read('viewer'));
  const started = [await viewer(createViewer, 0, document.getElementById('scenes'))];
  if (files.length === 2) {
    const right = document.createElement('div');
    right.id = 'right';
    started[0].handle.app.graphicsDevice.canvas.after(right); // above the first picture, below the controls
    started.push(await viewer(createViewer, 1, right));
    follow(started[0].handle, started[1].handle);
    divide(right, started[0].handle);
  }
  reachByTab(started[0].handle);
  await Promise.all(started.map(({ drawn }) => drawn));
  started[0].handle.events.fire('inputEvent', 'cancel'); // from the paused animation, which all scenes open with
  return started.map(({ handle }) => handle);
}

const ready = main();
window.g2ard = { ready };
ready.catch(error => {
  const trouble = document.getElementById('trouble');
  trouble.hidden = false;
  trouble.textContent = `This browser cannot show the scene: ${error.message ?? error}`;
});
