// The arms in 3D from the robot description: gravity, torques against their limits, joint limits; the trunk tilts.
//
// It is drawn at most ten times a second, and only when the browser is ready for a picture: drawing must never delay a
// press. Without WebGL a sentence replaces it.

import { colour } from "./colours.js";
import { Painter } from "./painter.js";
import { t, write } from "./texts.js";

const VIEWS = { front: [1.75, 0, 0], right: [0, -1.75, 0], left: [0, 1.75, 0], oblique: [1.45, -0.9, 0.35] };
const NARROWEST = 150; // px of a view; as many are drawn side by side as the picture is wide for
const WHOLE = 0.95; // width by height from which on a view is wide enough
const CENTRE = [0, 0, -0.27];
const GHOST = [0.04, 0.31, 0.62, 0.3]; // red, green, blue, opacity

export class Picture {
  constructor(place) {
    this.place = place;
    this.views = ["front"];
    this.turn = 0; // which of them was drawn last
    this.painter = new Painter(() => this.draw());
    this.description = "";
  }

  async configure(urdf) {
    if (!urdf || urdf === this.description) return;
    this.description = urdf;
    if (!this.three) {
      try {
        this.three = await import("./vendor/three.module.min.js");
        this.start();
      } catch {
        this.three = null;
      }
    }
    if (!this.renderer) {
      this.place.textContent = t("picture_none");
      return;
    }
    this.build(new DOMParser().parseFromString(urdf, "text/xml").documentElement);
  }

  start() {
    const T = this.three;
    this.renderer = new T.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    const canvas = this.renderer.domElement;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", t("picture_of"));
    this.names = document.createElement("div"); // of the views
    this.place.replaceChildren(canvas, this.names);
    this.renderer.setScissorTest(true);
    this.camera = new T.PerspectiveCamera(40, 1, 0.05, 20);
    this.camera.up.set(0, 0, 1);
    this.scene = new T.Scene();
    this.scene.add(new T.HemisphereLight("#ffffff", "#8a94a0", 2.5));
    this.gravity = new T.ArrowHelper(new T.Vector3(0, 0, -1), new T.Vector3(0, 0.45, 0), 0.35, 0, 0.09, 0.05);
    this.scene.add(this.gravity);
  }

  // robot: the root element of the URDF
  build(robot) {
    for (const old of [this.arms, this.ghost]) if (old) dispose(old.trunk);
    this.arms = this.assemble(robot);
    this.ghost = this.assemble(robot, GHOST);
    this.ghost.trunk.visible = false;
    for (const one of [this.arms, this.ghost]) this.scene.add(one.trunk);
    this.render();
  }

  // Returns the trunk with all that hangs on it, and its joints by name; in one colour, where one is given.
  assemble(robot, colour) {
    const T = this.three;
    const named = (tag) => [...robot.children].filter((part) => part.tagName === tag);
    const frames = Object.fromEntries(named("link").map((link) => [link.getAttribute("name"), new T.Group()]));
    const colours = Object.fromEntries(named("material").map((material) => [material.getAttribute("name"), colour ?? numbers(material, "color", "rgba")]));
    for (const link of named("link"))
      for (const visual of link.querySelectorAll("visual")) frames[link.getAttribute("name")].add(this.shape(visual, colours));
    const joints = {};
    for (const joint of named("joint")) {
      const child = frames[joint.querySelector("child").getAttribute("link")];
      const parent = frames[joint.querySelector("parent").getAttribute("link")];
      setPose(child, joint);
      parent.add(child);
      if (joint.querySelector("axis")) joints[joint.getAttribute("name")] = this.joint(joint, parent, child, !colour);
    }
    return { trunk: frames[robot.querySelector("joint > parent").getAttribute("link")], joints };
  }

  // A joint turns its child. Where it is marked, it has a bar for its torque and an arc from limit to limit.
  joint(joint, parent, child, marked) {
    const T = this.three;
    const axis = new T.Vector3(...numbers(joint, "axis", "xyz"));
    const start = new T.Quaternion().copy(child.quaternion);
    if (!marked) return { child, axis, start };
    const [lower] = numbers(joint, "limit", "lower");
    const [upper] = numbers(joint, "limit", "upper");
    const bar = new T.Mesh(new T.CylinderGeometry(0.014, 0.014, 1, 12), new T.MeshLambertMaterial({ color: 0x8b2f77 }));
    const turn = new T.Quaternion().setFromUnitVectors(new T.Vector3(0, 1, 0), axis);
    bar.quaternion.copy(turn);
    bar.scale.y = 0.001; // until a torque is known
    const arc = new T.Mesh(new T.TorusGeometry(0.07, 0.004, 6, 40, upper - lower), new T.MeshLambertMaterial({ color: 0x7a4b00 }));
    arc.quaternion.copy(new T.Quaternion().setFromUnitVectors(new T.Vector3(0, 0, 1), axis));
    arc.rotateZ(lower);
    const fixed = new T.Group();
    fixed.position.copy(child.position);
    fixed.add(arc, bar);
    parent.add(fixed);
    return { child, axis, bar, start };
  }

  shape(visual, colours) {
    const T = this.three;
    const geometry = visual.querySelector("geometry").firstElementChild;
    const value = (key) => Number(geometry.getAttribute(key));
    const bodies = {
      box: () => new T.BoxGeometry(...numbers(visual, "box", "size")),
      cylinder: () => new T.CylinderGeometry(value("radius"), value("radius"), value("length"), 24).rotateX(Math.PI / 2),
      sphere: () => new T.SphereGeometry(value("radius"), 20, 14),
    };
    const [red, green, blue, opacity] = colours[visual.querySelector("material").getAttribute("name")];
    const material = new T.MeshLambertMaterial({ color: new T.Color(red, green, blue), transparent: opacity < 1, opacity });
    const mesh = new T.Mesh(bodies[geometry.tagName](), material);
    setPose(mesh, visual);
    return mesh;
  }

  // target: rad, the pose to which a trial leads the arms: the ghost shows it.
  pose(arms, tilt, setups, target) {
    if (!this.renderer || !this.arms) return;
    const sides = Object.keys(VIEWS).filter((view) => view in arms);
    this.views = ["front", ...(sides.length ? sides : ["right"]), "oblique"];
    for (const [arm, state] of Object.entries(arms))
      (state.joints ?? []).forEach((joint, n) => {
        const part = this.arms.joints[joint.name];
        if (!part) return;
        if (joint.position !== null) this.rotate(part, joint.position);
        if (target) this.rotate(this.ghost.joints[joint.name], target[n]);
        const share = (joint.effort ?? 0) / (setups[arm]?.max_effort?.[n] || 1);
        part.bar.scale.y = Math.max(0.001, 0.25 * Math.abs(share));
        part.bar.position.copy(part.axis).multiplyScalar(0.125 * share);
      });
    // pitch: forward, about y; roll: to the right, about x
    if (tilt) for (const one of [this.arms, this.ghost]) one.trunk.rotation.set(tilt.roll, tilt.pitch, 0, "ZYX");
    this.ghost.trunk.visible = Boolean(target);
    this.render();
  }

  rotate(part, angle) {
    part.child.quaternion.copy(part.start).multiply(new this.three.Quaternion().setFromAxisAngle(part.axis, angle));
  }

  render() {
    this.painter.request();
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.place;
    if (!width || !height) return;
    if (this.width !== width || this.height !== height) this.renderer.setSize(width, height, false);
    [this.width, this.height] = [width, height];
    const views = this.views.slice(0, Math.max(1, Math.floor(width / NARROWEST)));
    const share = width / views.length;
    this.camera.aspect = share / height;
    this.camera.updateProjectionMatrix();
    this.scene.background = new this.three.Color(colour("--ground"));
    this.gravity.setColor(colour("--accent"));
    while (this.names.children.length > views.length) this.names.lastElementChild.remove();
    views.forEach((view, n) => write(this.names.children[n] ?? this.names.appendChild(document.createElement("span")), t(`view.${view}`)));
    this.turn = (this.turn + 1) % views.length; // one of them at a time: it blocks the page for shorter
    for (const area of ["setViewport", "setScissor"]) this.renderer[area](this.turn * share, 0, share, height);
    const far = Math.max(1, WHOLE / this.camera.aspect); // a narrow view shows the whole arm, too
    this.camera.position.set(...VIEWS[views[this.turn]].map((value, axis) => far * value + CENTRE[axis]));
    this.camera.lookAt(...CENTRE);
    this.renderer.render(this.scene, this.camera);
    this.renderer.getContext().finish(); // else a slow computer queues pictures
  }
}

// The numbers in attribute `key` of the first `tag` within an element; none if it is absent.
function numbers(element, tag, key) {
  const text = element.querySelector(tag)?.getAttribute(key);
  return text ? text.trim().split(/\s+/).map(Number) : [];
}

// Sets the pose of `part` to the element's origin.
function setPose(part, element) {
  const [x = 0, y = 0, z = 0] = numbers(element, "origin", "xyz");
  const [roll = 0, pitch = 0, yaw = 0] = numbers(element, "origin", "rpy");
  part.position.set(x, y, z);
  part.rotation.set(roll, pitch, yaw, "ZYX");
}

function dispose(root) {
  root.traverse((part) => {
    part.geometry?.dispose();
    part.material?.dispose();
  });
  root.removeFromParent();
}
