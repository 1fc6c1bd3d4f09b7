// A robot on a checkered floor, drawn by three.js.
"use strict";

class Scene {
  static TILE = 2; // m
  // Where the camera is from the robot, and the height at which it looks (m).
  static VIEWS = { half_cheetah: [0.6, -3.4, 0.9, 0.35], ant: [-1.6, -3.6, 2.4, 0.2], walker2d: [0.7, -4, 0.6, 0.8] };

  constructor(THREE, canvas, colour) {
    Object.assign(this, { THREE, canvas, colour, bodies: [] });
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.shadowMap.enabled = true;
    this.world = new THREE.Scene();
    this.world.background = new THREE.Color("#dfe8f0");
    this.world.fog = new THREE.Fog("#dfe8f0", 9, 30);
    this.camera = new THREE.PerspectiveCamera(34, 1, 0.1, 60);
    this.camera.up.set(0, 0, 1);
    this.floor = this.checkered();
    this.lights();
    this.world.add(this.floor);
  }

  show(name, model) {
    this.view = Scene.VIEWS[name];
    this.world.remove(...this.bodies);
    this.bodies = this.shapes(model);
    this.world.add(...this.bodies);
  }

  checkered() {
    const { THREE } = this, size = 80, canvas = Object.assign(document.createElement("canvas"), { width: 2, height: 2 });
    const pen = canvas.getContext("2d");
    [pen.fillStyle, pen.imageSmoothingEnabled] = ["#f4f6f8", false];
    pen.fillRect(0, 0, 2, 2);
    pen.fillStyle = "#b9c6d2";
    pen.fillRect(0, 0, 1, 1);
    pen.fillRect(1, 1, 1, 1);
    const texture = new THREE.CanvasTexture(canvas);
    Object.assign(texture, { wrapS: THREE.RepeatWrapping, wrapT: THREE.RepeatWrapping, magFilter: THREE.NearestFilter });
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.repeat.setScalar(size / (2 * Scene.TILE));
    const floor = new THREE.Mesh(new THREE.PlaneGeometry(size, size), new THREE.MeshStandardMaterial({ map: texture }));
    floor.receiveShadow = true;
    return floor;
  }

  lights() {
    const { THREE } = this;
    this.sun = new THREE.DirectionalLight("#ffffff", 2.2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.setScalar(1024);
    Object.assign(this.sun.shadow.camera, { left: -3, right: 3, top: 3, bottom: -3, near: 1, far: 15 });
    this.world.add(this.sun, this.sun.target, new THREE.HemisphereLight("#ffffff", "#9aa7b4", 1.6));
  }

  // Capsules and spheres of the model; those that it paints otherwise than its first one are darker.
  shapes(model) {
    const { THREE } = this, { geom_type, geom_size, geom_rgba } = model;
    const paint = (k) => geom_rgba.slice(4 * k, 4 * k + 3).join();
    return Array.from(geom_type, (type, k) => {
      if (type === 0) return new THREE.Group(); // the floor is drawn separately
      const [radius, half] = geom_size.slice(3 * k, 3 * k + 2);
      const shape = type === 2 ? new THREE.SphereGeometry(radius, 32, 24) : new THREE.CapsuleGeometry(radius, 2 * half, 8, 24);
      shape.rotateX(Math.PI / 2); // MuJoCo's are along z
      const shade = new THREE.Color(this.colour).multiplyScalar(paint(k) === paint(1) ? 1 : 0.6);
      const body = new THREE.Mesh(shape, new THREE.MeshStandardMaterial({ color: shade, roughness: 0.5 }));
      Object.assign(body, { castShadow: true, receiveShadow: true, matrixAutoUpdate: false });
      return body;
    });
  }

  draw({ places, turns }) {
    const { camera, canvas, sun } = this, [x, y] = places.slice(3, 5), [ahead, aside, above, height] = this.view;
    const [width, tall] = [canvas.clientWidth, canvas.clientHeight];
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
    this.renderer.setSize(width, tall, false);
    this.bodies.forEach((body, k) => {
      const [a, b, c, d, e, f, g, h, i] = turns.slice(9 * k, 9 * k + 9);
      const [px, py, pz] = places.slice(3 * k, 3 * k + 3);
      body.matrix.set(a, b, c, px, d, e, f, py, g, h, i, pz, 0, 0, 0, 1);
    });
    const period = 2 * Scene.TILE;
    this.floor.position.set(period * Math.round(x / period), period * Math.round(y / period), 0);
    sun.position.set(x - 2, y - 3, 6);
    sun.target.position.set(x, y, 0);
    camera.aspect = width / tall;
    camera.updateProjectionMatrix();
    camera.position.set(x + ahead, y + aside, above);
    camera.lookAt(x, y, height);
    this.renderer.render(this.world, camera);
  }
}
