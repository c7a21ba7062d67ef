// The room in three dimensions, for the page of usdbrdf: orbit, looks, lamps, daylight, picking. Bundled with
// three.js by build.mjs; the page calls usdbrdfRoom.start.
import {
  AmbientLight, Box3, Color, ColorManagement, DirectionalLight, DoubleSide,
  EquirectangularReflectionMapping, LinearToneMapping, MeshBasicMaterial, PCFShadowMap,
  PerspectiveCamera, PointLight, Raycaster, SRGBColorSpace, Scene, TextureLoader, Vector2, Vector3,
  WebGLRenderer,
} from 'three';
import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';

ColorManagement.enabled = true;
// Of the light that surfaces send on to each other, which is not traced here, so much is left when
// lamps and sun are on, as a share of the irradiance that was measured. That of the sky, which comes
// from many sides, is all of this kind.
const INDIRECT = 0.5;
const NIGHT = 0x0b0d10;
// Pixels across the map of the sun's shadows.
const SHADOWS = 4096;

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Response(stream).arrayBuffer();
}

/* Takes back what usdbrdf/page/small_glb.py does to arrays of a file, in place: differences of each
   column, their lowest bytes first, become numbers. */
function unfiltered(file) {
  const length = new DataView(file).getUint32(12, true);
  const document = JSON.parse(new TextDecoder().decode(new Uint8Array(file, 20, length)));
  for (const [index, size] of Object.entries(document.extras?.usdbrdfFiltered || {})) {
    const { byteOffset = 0, byteLength, byteStride = size } = document.bufferViews[index];
    const bytes = new Uint8Array(file, 28 + length + byteOffset, byteLength), steps = bytes.slice();
    const rows = byteLength / byteStride;
    for (let column = 0; column < byteStride; column += size) {
      for (let row = 0, value = 0; row < rows; row += 1) {
        for (let k = 0; k < size; k += 1) value = (value + (steps[(column + k) * rows + row] << (8 * k))) | 0;
        for (let k = 0; k < size; k += 1) bytes[row * byteStride + column + k] = value >> (8 * k);
      }
    }
  }
  return file;
}

/* room: data of the page; colours: look -> prim -> [r, g, b] of one colour per object; pick(prim)
   is called with an object, or null. Resolves to what the page's controls call. */
export async function start(canvas, room, colours, pick) {
  const renderer = new WebGLRenderer({ canvas, antialias: true });
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.toneMapping = LinearToneMapping;
  const scene = new Scene();
  const night = scene.background = new Color(NIGHT);
  const { scene: model } = await new GLTFLoader().parseAsync(unfiltered(await unpacked(room.glb)), '');
  scene.add(model);
  const meshes = [], others = [];
  model.traverse((node) => {
    // Lights of the file's own, which are told again below, with what can be switched.
    if (node.isLight) others.push(node);
    if (!node.isMesh) return;
    let owner = node;
    while (owner && !(owner.userData && owner.userData.usdPrim)) owner = owner.parent;
    node.userData.prim = owner ? owner.userData.usdPrim : node.name;
    node.userData.shaded = node.material;
    // What is clear lets the sun pass; of walls either side stops it.
    node.castShadow = !(node.material.transmission > 0);
    node.receiveShadow = true;
    node.material.shadowSide = DoubleSide;
    meshes.push(node);
  });

  for (const node of others) node.removeFromParent();

  const box = new Box3().setFromObject(model);
  const size = box.getSize(new Vector3());
  const reach = size.length();
  const camera = new PerspectiveCamera(60, 1, reach / 1000, reach * 10);
  const controls = new OrbitControls(camera, canvas);
  const home = () => {
    if (room.first) {
      camera.position.set(...room.first.eye);
      controls.target.set(...room.first.target);
    } else {
      const centre = box.getCenter(new Vector3());
      controls.target.copy(centre);
      // From a corner inside of a room; the faces of rooms are seen from within.
      camera.position.copy(centre).add(new Vector3(0.36 * size.x, 0.12 * size.y, 0.36 * size.z));
    }
    controls.update();
  };
  home();

  const lamps = room.lamps.map((lamp) => {
    const light = new PointLight(new Color(1, 1, 1), 1, 0, 2);
    const [r, g, b] = lamp.intensity;
    const most = Math.max(r, g, b, 1e-12);
    light.color.setRGB(r / most, g / most, b / most);
    light.userData = { full: most, on: true, prim: lamp.prim };
    light.position.set(...lamp.place);
    scene.add(light);
    return light;
  });
  const moved = new PointLight(0xffffff, 0, 0, 2);
  moved.position.copy(box.getCenter(new Vector3()));
  scene.add(moved);
  const ambient = new AmbientLight(0xffffff, 1);
  scene.add(ambient);
  const { sky = null, sun = null } = room.outside || {};
  const on = { sky: true, sun: true };
  let behind = null;
  if (sky) {
    behind = await new TextureLoader().loadAsync(sky.picture);
    behind.mapping = EquirectangularReflectionMapping;
    behind.colorSpace = SRGBColorSpace;
  }
  let sunlight = null;
  if (sun) {
    const most = Math.max(...sun.irradiance);
    sunlight = new DirectionalLight(new Color(), most);
    sunlight.color.setRGB(...sun.irradiance.map((value) => value / most));
    const centre = box.getCenter(new Vector3());
    sunlight.target.position.copy(centre);
    sunlight.position.copy(centre).addScaledVector(new Vector3(...sun.direction), reach);
    sunlight.castShadow = true;
    const { shadow } = sunlight;
    const side = Math.min(SHADOWS, renderer.capabilities.maxTextureSize);
    shadow.mapSize.set(side, side);
    const half = reach / 2;
    Object.assign(shadow.camera, {
      left: -half, right: half, top: half, bottom: -half, near: reach / 4, far: 2 * reach,
    });
    // Of a pixel of the map, so that no surface shades itself, and little light leaks at edges.
    shadow.normalBias = 0.5 * reach / side;
    shadow.bias = -5e-4;
    scene.add(sunlight, sunlight.target);
    renderer.shadowMap.enabled = true;
    renderer.shadowMap.type = PCFShadowMap;
    // Nothing moves in the room: they are drawn once.
    shadow.autoUpdate = false;
    shadow.needsUpdate = true;
  }
  // Of each source what it brings to the surfaces directly, the mean over them.
  const spread = 4 * Math.PI / Math.max(room.area, 1e-12);
  const direct = (source) => (source ? Math.max(...source.direct) : 0);
  const total = room.lamps.reduce((sum, lamp) => sum + spread * Math.max(...lamp.intensity), 0)
    + direct(sky) + direct(sun);
  const irradiance = Math.max(...room.irradiance, 1e-12);
  let extra = 0;
  let look = 'shaded';

  function light() {
    let lit = spread * extra;
    for (const lamp of lamps) {
      lamp.intensity = lamp.userData.on ? lamp.userData.full : 0;
      lit += spread * lamp.intensity;
    }
    moved.intensity = extra;
    if (sunlight) {
      sunlight.visible = on.sun;
      lit += on.sun ? direct(sun) : 0;
    }
    const even = INDIRECT * lit + (on.sky ? direct(sky) : 0);
    ambient.color.setRGB(...room.irradiance.map((value) => value / irradiance));
    ambient.intensity = irradiance * (total > 0 ? even / total : 1);
    background();
    for (const mesh of meshes) {
      const lamp = lamps.find((one) => one.userData.prim === mesh.userData.prim);
      if (lamp && mesh.userData.shaded.emissive) {
        const material = mesh.userData.shaded;
        material.userData.strength ??= material.emissiveIntensity;
        material.emissiveIntensity = lamp.userData.on ? material.userData.strength : 0;
      }
    }
    draw();
  }

  function background() {
    scene.background = behind && on.sky && look === 'shaded' ? behind : night;
  }

  const textures = {};
  const plain = (colour, map) => {
    const material = new MeshBasicMaterial({ side: DoubleSide, toneMapped: false });
    if (colour) material.color.setRGB(...colour);
    if (map) material.map = map;
    return material;
  };
  function litTexture(prim) {
    if (!textures[prim] && room.lit[prim]) {
      const texture = new TextureLoader().load(room.lit[prim], draw);
      texture.flipY = false;
      texture.colorSpace = SRGBColorSpace;
      textures[prim] = texture;
    }
    return textures[prim];
  }
  function setLook(name) {
    look = name;
    for (const mesh of meshes) {
      const { prim, shaded } = mesh.userData;
      if (mesh.material !== shaded) mesh.material.dispose();
      if (name === 'shaded') mesh.material = shaded;
      else if (name === 'lit') mesh.material = plain(null, litTexture(prim));
      else if (name === 'base_color') mesh.material = plain(shaded.color.toArray(), shaded.map);
      else mesh.material = plain(colours[name][prim] || [0.02, 0.02, 0.02]);
    }
    renderer.toneMappingExposure = room.exposure;
    background();
    draw();
  }

  const caster = new Raycaster();
  function pickAt(x, y) {
    const frame = canvas.getBoundingClientRect();
    const point = new Vector2(
      (2 * (x - frame.left)) / frame.width - 1, 1 - (2 * (y - frame.top)) / frame.height);
    // The camera may have turned since the last picture.
    camera.updateMatrixWorld();
    caster.setFromCamera(point, camera);
    const hit = caster.intersectObjects(meshes, false)[0];
    pick(hit ? hit.object.userData.prim : null);
    return hit ? hit.object.userData.prim : null;
  }
  let pressed = null;
  canvas.addEventListener('pointerdown', (event) => { pressed = [event.clientX, event.clientY]; });
  canvas.addEventListener('pointerup', (event) => {
    if (pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 5) {
      pickAt(event.clientX, event.clientY);
    }
  });
  canvas.addEventListener('keydown', (event) => {
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (turn[event.key]) {
      event.preventDefault();
      const offset = camera.position.clone().sub(controls.target);
      offset.applyAxisAngle(new Vector3(0, 1, 0), 0.1 * turn[event.key][0]);
      offset.y += 0.08 * offset.length() * turn[event.key][1];
      camera.position.copy(controls.target).add(offset);
      controls.update();
    } else if (event.key === '+' || event.key === '-') {
      camera.position.lerp(controls.target, event.key === '+' ? 0.1 : -0.1);
      controls.update();
    } else if (event.key === 'Enter') {
      const frame = canvas.getBoundingClientRect();
      pickAt(frame.left + frame.width / 2, frame.top + frame.height / 2);
    }
  });

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const { clientWidth: width, clientHeight: height } = canvas;
      const now = renderer.getSize(new Vector2());
      if (now.x !== width || now.y !== height) {
        renderer.setSize(width, height, false);
        camera.aspect = width / Math.max(height, 1);
        camera.updateProjectionMatrix();
      }
      renderer.render(scene, camera);
    });
  }
  controls.addEventListener('change', draw);
  new ResizeObserver(draw).observe(canvas);
  setLook(look);
  light();
  return {
    setLook,
    setLamp(index, shines) { lamps[index].userData.on = shines; light(); },
    // name: 'sky' or 'sun'.
    setOutside(name, shines) { on[name] = shines; light(); },
    // Of the movable light: shares of the room's box along x, y up, and z; strength as a share of
    // all captured light together.
    moveLight(x, y, z, strength) {
      moved.position.set(
        box.min.x + x * size.x, box.min.y + y * size.y, box.min.z + z * size.z);
      extra = strength * (total / spread || irradiance * reach * reach * 0.05);
      light();
    },
    home() { home(); draw(); },
    pickAt,
    // Where an object's middle is on the screen, for tests and for people who search it.
    look(prim) {
      const mesh = meshes.find((one) => one.userData.prim === prim);
      if (!mesh) return;
      const centre = new Box3().setFromObject(mesh).getCenter(new Vector3());
      controls.target.copy(centre);
      controls.update();
      draw();
    },
  };
}
