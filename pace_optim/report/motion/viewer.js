"use strict";
// The robot in 3-D: measured motion as a ghost, simulated motion over it, coloured by error. WebGL 1, no library.
pace.ready.then(() => {
  const MOST_PIECES = 24; // of a round shape
  const read = (element) => JSON.parse(element.querySelector('script[type="application/json"]').textContent);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // ---- rotations: quaternions are (w, x, y, z) as MuJoCo's --------------------------------------------------------
  const multiply = (a, b) => [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3], a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1], a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
  const rotate = (q, v) => {
    const [w, x, y, z] = q;
    const t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
    return [
      v[0] + w * t[0] + y * t[2] - z * t[1], v[1] + w * t[1] + z * t[0] - x * t[2], v[2] + w * t[2] + x * t[1] - y * t[0],
    ];
  };
  const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
  const turn = (axis, angle) => {
    const s = Math.sin(angle / 2);
    return [Math.cos(angle / 2), axis[0] * s, axis[1] * s, axis[2] * s];
  };
  /** Column-major 4x4 of a pose with half sizes. */
  const matrix = (pos, q, size) => {
    const columns = [[size[0], 0, 0], [0, size[1], 0], [0, 0, size[2]]].map((v) => rotate(q, v));
    return [...columns[0], 0, ...columns[1], 0, ...columns[2], 0, ...pos, 1];
  };

  const WORLD = { pos: [0, 0, 0], quat: [1, 0, 0, 0] };

  /** Forward kinematics: every body's pose from the positions of hinge and slide joints (MuJoCo's order of frames). */
  function poses(scene, at, base) {
    const result = [base ?? WORLD];
    scene.bodies.forEach((body, b) => {
      if (b === 0) return;
      const parent = result[body.parent];
      let pos = add(parent.pos, rotate(parent.quat, body.pos)), quat = multiply(parent.quat, body.quat);
      for (const j of body.joints) {
        const joint = scene.joints[j], value = at(j) - joint.ref;
        if (joint.type === "slide") pos = add(pos, rotate(quat, joint.axis.map((x) => x * value)));
        else {
          const anchor = add(pos, rotate(quat, joint.pos));
          quat = multiply(quat, turn(joint.axis, value));
          pos = add(anchor, rotate(quat, joint.pos.map((x) => -x)));
        }
      }
      result.push({ pos, quat });
    });
    return result;
  }

  // ---- shapes: triangles of position and normal, half sizes of one -------------------------------------------------
  function revolve(profile) { // [[radius, height, normal out, normal up], ...] around z
    const out = [];
    const point = ([r, h, n, u], i) => {
      const a = (2 * Math.PI * i) / MOST_PIECES;
      return [r * Math.cos(a), r * Math.sin(a), h, n * Math.cos(a), n * Math.sin(a), u];
    };
    for (let k = 0; k + 1 < profile.length; k++)
      for (let i = 0; i < MOST_PIECES; i++) {
        const [a, b, c, d] = [point(profile[k], i), point(profile[k], i + 1), point(profile[k + 1], i + 1), point(profile[k + 1], i)];
        out.push(...a, ...b, ...c, ...a, ...c, ...d);
      }
    return out;
  }
  const arc = (from, to, lift) => Array.from({ length: 9 }, (_, i) => {
    const t = from + ((to - from) * i) / 8;
    return [Math.cos(t), lift + Math.sin(t), Math.cos(t), Math.sin(t)];
  });
  const SHAPES = {
    sphere: () => revolve(arc(-Math.PI / 2, Math.PI / 2, 0)),
    cylinder: () => revolve([[0, -1, 0, -1], [1, -1, 0, -1], [1, -1, 1, 0], [1, 1, 1, 0], [1, 1, 0, 1], [0, 1, 0, 1]]),
    box: () => {
      const out = [];
      for (let axis = 0; axis < 3; axis++)
        for (const side of [-1, 1]) {
          const corner = (u, v) => {
            const p = [0, 0, 0], n = [0, 0, 0];
            p[axis] = n[axis] = side;
            p[(axis + 1) % 3] = u;
            p[(axis + 2) % 3] = v;
            return [...p, ...n];
          };
          const [a, b, c, d] = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
          out.push(...a, ...b, ...c, ...a, ...c, ...d);
        }
      return out;
    },
  };
  /** A capsule has half spheres that no scaling keeps round: it is made in its own size. */
  const capsule = (radius, half) => revolve(
    [...arc(-Math.PI / 2, 0, 0).map(([r, h, n, u]) => [r * radius, h * radius - half, n, u]),
      ...arc(0, Math.PI / 2, 0).map(([r, h, n, u]) => [r * radius, h * radius + half, n, u])]);
  /** Columns, each a curve, row by row. */
  function rows(columns) {
    const out = new Float64Array(columns.length * (columns[0]?.by.length ?? 0));
    columns.forEach((column, j) => pace.curve(column).forEach((value, i) => { out[i * columns.length + j] = value; }));
    return out;
  }
  function meshTriangles(mesh) {
    const vertices = rows(mesh.vertices), faces = pace.curve(mesh.faces);
    const out = [], at = (i) => [...vertices.subarray(3 * i, 3 * i + 3)];
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [at(faces[f]), at(faces[f + 1]), at(faces[f + 2])];
      const u = b.map((x, i) => x - a[i]), v = c.map((x, i) => x - a[i]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const length = Math.hypot(...n) || 1, normal = n.map((x) => x / length);
      for (const p of [a, b, c]) out.push(...p, ...normal);
    }
    return out;
  }

  // ---- drawing -----------------------------------------------------------------------------------------------------
  const VERTEX = `attribute vec3 position, normal; uniform mat4 camera, model; uniform mat3 turn; varying vec3 n;
    void main() { n = turn * normal; gl_Position = camera * model * vec4(position, 1.0); }`;
  const FRAGMENT = `precision mediump float; varying vec3 n; uniform vec4 colour;
    void main() { float light = 0.45 + 0.55 * abs(dot(normalize(n), normalize(vec3(0.4, -0.5, 0.8))));
      gl_FragColor = vec4(colour.rgb * light * colour.a, colour.a); }`;

  function makeRenderer(canvas, scene) {
    const gl = canvas.getContext("webgl", { antialias: true, alpha: true, preserveDrawingBuffer: true });
    if (!gl) return null;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    const place = (name) => gl.getUniformLocation(program, name);
    const uniforms = { camera: place("camera"), model: place("model"), turn: place("turn"), colour: place("colour") };
    const [position, normal] = [gl.getAttribLocation(program, "position"), gl.getAttribLocation(program, "normal")];
    gl.enableVertexAttribArray(position);
    gl.enableVertexAttribArray(normal);
    const shapes = new Map();
    const buffer = (key, make) => {
      if (!shapes.has(key)) {
        const data = new Float32Array(make()), vbo = gl.createBuffer();
        gl.bindBuffer(gl.ARRAY_BUFFER, vbo);
        gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
        shapes.set(key, { vbo, count: data.length / 6 });
      }
      return shapes.get(key);
    };
    const pieces = scene.geoms.map((geom) => {
      const one = [1, 1, 1], [a, b, c] = geom.size;
      const of = { ...geom, pos: geom.shift ? add(geom.pos, rotate(geom.quat, geom.shift)) : geom.pos };
      if (geom.shape === "mesh") return { ...of, scale: one, shape: buffer(`mesh ${geom.mesh}`, () => meshTriangles(scene.meshes[geom.mesh])) };
      if (geom.shape === "capsule") return { ...of, scale: one, shape: buffer(`capsule ${a} ${b}`, () => capsule(a, b)) };
      const name = geom.shape === "ellipsoid" ? "sphere" : geom.shape;
      const scale = { sphere: [a, a, a], cylinder: [a, a, b] }[geom.shape] ?? [a, b, c];
      return { ...of, scale, shape: buffer(name, SHAPES[name]) };
    });

    function draw(robot, colourOf, shown = pieces) {
      for (const piece of shown) {
        const body = piece.body ? robot[piece.body] : WORLD, quat = multiply(body.quat, piece.quat);
        const pos = add(body.pos, rotate(body.quat, piece.pos));
        gl.bindBuffer(gl.ARRAY_BUFFER, piece.shape.vbo);
        gl.vertexAttribPointer(position, 3, gl.FLOAT, false, 24, 0);
        gl.vertexAttribPointer(normal, 3, gl.FLOAT, false, 24, 12);
        gl.uniformMatrix4fv(uniforms.model, false, matrix(pos, quat, piece.scale));
        const inverse = piece.scale.map((s) => 1 / (s || 1));
        gl.uniformMatrix3fv(uniforms.turn, false, [[inverse[0], 0, 0], [0, inverse[1], 0], [0, 0, inverse[2]]].flatMap((v) => rotate(quat, v)));
        gl.uniform4fv(uniforms.colour, colourOf(piece));
        gl.drawArrays(gl.TRIANGLES, 0, piece.shape.count);
      }
    }

    const ball = buffer("sphere", SHAPES.sphere), tile = buffer("box", SHAPES.box);
    const mark = (shape, pos, scale, colour) => draw([], () => colour, [{ body: 0, pos, quat: WORLD.quat, scale, shape }]);

    return (camera, simulated, measured, colourOf, marks = { feet: [], tiles: [] }) => {
      const width = Math.round(canvas.clientWidth * devicePixelRatio), height = Math.round(canvas.clientHeight * devicePixelRatio);
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.uniformMatrix4fv(uniforms.camera, false, camera(width / Math.max(1, height)));
      gl.disable(gl.BLEND);
      gl.depthMask(true);
      for (const [pos, size, colour] of marks.tiles) mark(tile, pos, size, colour);
      draw(simulated, colourOf);
      for (const [pos, size, colour] of marks.feet) mark(ball, pos, [size, size, size], colour);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.depthMask(false);
      draw(measured, () => [0.25, 0.5, 0.85, 0.3]);
      gl.depthMask(true);
    };
  }

  /** Looks at the middle of the robot from a distance; drag turns, the wheel comes closer, z points up. */
  function makeCamera(scene) {
    const view = { azimuth: -0.9, elevation: 0.35, distance: 1.5 * scene.size, center: scene.center };
    view.matrix = (aspect) => {
      const [ca, sa, ce, se] = [Math.cos(view.azimuth), Math.sin(view.azimuth), Math.cos(view.elevation), Math.sin(view.elevation)];
      const back = [ce * ca, ce * sa, se], right = [-sa, ca, 0], up = [-se * ca, -se * sa, ce];
      const eye = back.map((x, i) => view.center[i] + x * view.distance);
      const f = 1 / Math.tan(0.35), near = view.distance / 50, far = view.distance * 20;
      const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
      const rows = [right, up, back].map((axis) => [...axis, -dot(axis, eye)]);
      const p = [f / aspect, f, (far + near) / (near - far), (2 * far * near) / (near - far)];
      const out = [];
      for (let c = 0; c < 4; c++)
        out.push(p[0] * rows[0][c], p[1] * rows[1][c], p[2] * rows[2][c] + (c === 3 ? p[3] : 0), -rows[2][c]);
      return out;
    };
    return view;
  }

  /** From grey over amber to red. */
  const heat = (share) => {
    const s = Math.min(1, Math.max(0, share)), stops = [[0.72, 0.74, 0.76], [0.95, 0.68, 0.25], [0.8, 0.16, 0.1]];
    const i = s < 0.5 ? 0 : 1, t = 2 * s - i;
    return stops[i].map((value, c) => value + t * (stops[i + 1][c] - value));
  };

  function makeReplay(element) {
    const content = read(element), scene = content.scene, canvas = element.querySelector("canvas");
    for (const body of scene.bodies) body.joints = [];
    scene.joints.forEach((joint, j) => scene.bodies[joint.body].joints.push(j));
    const m = scene.joints.length, count = content.recordings.length;
    const recordings = content.recordings.map((recording) => ({
      ...recording, time: pace.curve(recording.time), measured: rows(recording.measured), error: rows(recording.error),
      base: recording.base && rows(recording.base), standing: recording.base && rows(recording.standing),
    }));
    for (const recording of recordings) recording.simulated = recording.measured.map((value, i) => value + recording.error[i]);
    const render = makeRenderer(canvas, scene);
    if (!render) {
      element.querySelector(".replay-note").textContent = "This browser draws no WebGL, so the replay cannot be shown.";
      return;
    }
    const find = (name) => element.querySelector(`[name="${name}"]`);
    const chosen = () => recordings[Number(element.querySelector('[data-choice="recording"] input:checked')?.value ?? 0) % count];
    const camera = makeCamera(scene);
    const state = { at: 0, playing: false, last: 0 };

    /** Column j of a series at time t, linear between pictures; m columns are those of joints. */
    function sample(recording, series, j, t, columns = m) {
      const time = recording.time;
      let low = 0, high = time.length - 1;
      while (high - low > 1) {
        const middle = (low + high) >> 1;
        if (time[middle] <= t) low = middle;
        else high = middle;
      }
      const share = high === low ? 0 : Math.min(1, Math.max(0, (t - time[low]) / (time[high] - time[low])));
      return series[low * columns + j] * (1 - share) + series[high * columns + j] * share;
    }

    /** Where a base that moves is at time t. */
    function baseAt(recording, t) {
      if (!recording.base) return undefined;
      const row = [0, 1, 2, 3, 4, 5, 6].map((j) => sample(recording, recording.base, j, t, 7)), size = Math.hypot(...row.slice(3));
      return { pos: row.slice(0, 3), quat: row.slice(3).map((x) => x / size) };
    }
    /** Feet, and the ground's tiles around them. */
    function marksAt(recording, robot, t) {
      if (!recording.base) return undefined;
      const radius = 0.03 * scene.size, edge = 0.4 * scene.size, middle = recording.where.pos.map((x) => Math.round(x / edge));
      const feet = recording.feet.map((foot, f) => [
        add(robot[foot.body].pos, rotate(robot[foot.body].quat, foot.pos)), radius,
        sample(recording, recording.standing, f, t, recording.feet.length) > 0.5 ? [0.2, 0.6, 0.3, 1] : [0.95, 0.6, 0.2, 1],
      ]);
      const tiles = [];
      if (feet.length)
        for (let i = -3; i <= 3; i++)
          for (let j = -3; j <= 3; j++)
            if ((i + j + middle[0] + middle[1]) % 2 === 0)
              tiles.push([[(middle[0] + i) * edge, (middle[1] + j) * edge, -radius - 0.01 * edge], [edge / 2, edge / 2, 0.01 * edge], [0.8, 0.81, 0.83, 1]]);
      return { feet, tiles };
    }

    function draw() {
      const recording = chosen(), t = state.at, times = Number(find("exaggerate").value), base = baseAt(recording, t);
      recording.where = base;
      camera.center = base ? add(base.pos, rotate(base.quat, scene.center)) : scene.center;
      const measured = (j) => sample(recording, recording.measured, j, t);
      const error = (j) => sample(recording, recording.simulated, j, t) - measured(j);
      const share = scene.bodies.map((body) => Math.max(0, ...body.joints.map((j) => Math.abs(error(j)) / content.scale[j])));
      const ghost = poses(scene, measured, base);
      render(camera.matrix, poses(scene, (j) => measured(j) + times * error(j), base), ghost, (piece) => [...heat(share[piece.body]), 1], marksAt(recording, ghost, t));
      const worst = scene.joints.map((_, j) => Math.abs(error(j)) / content.scale[j]).reduce((a, x, j, all) => (x > all[a] ? j : a), 0);
      const factor = scene.joints[worst].type === "slide" ? [1e3, "mm"] : [1e3, "mrad"];
      element.querySelector(".replay-note").textContent =
        `${t.toFixed(2)} s of ${recording.time[recording.time.length - 1].toFixed(1)} s. Largest: ${content.joints[worst]} ${(factor[0] * error(worst)).toPrecision(3)} ${factor[1]}`;
      find("at").value = t;
    }
    function tick(now) {
      if (!state.playing) return;
      const end = chosen().time[chosen().time.length - 1];
      state.at += ((now - state.last) / 1000) * Number(find("speed").value);
      state.last = now;
      if (state.at > end) state.at = 0;
      draw();
      requestAnimationFrame(tick);
    }
    const play = (on) => {
      state.playing = on;
      state.last = performance.now();
      element.querySelector(".play").textContent = on ? "Pause" : "Play";
      if (on) requestAnimationFrame(tick);
    };
    function open() {
      state.at = 0;
      find("at").max = chosen().time[chosen().time.length - 1];
      draw();
    }
    element.querySelector(".play").addEventListener("click", () => play(!state.playing));
    find("at").addEventListener("input", () => { state.at = Number(find("at").value); draw(); });
    for (const name of ["speed", "exaggerate"]) find(name).addEventListener("change", draw);
    element.addEventListener("change", (event) => { if (event.target.name?.endsWith("recording")) open(); });
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      camera.azimuth -= event.movementX * 0.008;
      camera.elevation = Math.min(1.5, Math.max(-1.5, camera.elevation + event.movementY * 0.008));
      draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      camera.distance *= Math.exp(event.deltaY * 0.001);
      draw();
    }, { passive: false });
    new ResizeObserver(draw).observe(canvas);
    element.replay = { joints: (which, t) => scene.joints.map((_, j) => sample(chosen(), chosen()[which], j, t)), seek: (t) => { state.at = t; draw(); }, poses: (which, t) => poses(scene, (j) => sample(chosen(), chosen()[which], j, t), baseAt(chosen(), t)), state };
    open();
  }
  for (const element of document.querySelectorAll(".replay")) makeReplay(element);
});
