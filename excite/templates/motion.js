"use strict";
for (const place of document.querySelectorAll(".motion")) {
  const s = JSON.parse(place.nextElementSibling.textContent);
  const PALETTE = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"];
  const NEAR = "#c0392b";  // the two things that are nearest to each other
  const end = s.t[s.t.length - 1], owners = [...new Set(s.names)];
  const element = (name, text = "") => Object.assign(document.createElement(name), { textContent: text });

  const canvas = element("canvas"), controls = element("div"), now = element("div");
  const play = element("button", "Play"), slider = element("input"), speed = element("select"), time = element("span");
  controls.className = "controls";
  now.className = "now";
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `${s.title}; drag to turn, wheel or + and - to zoom`);
  canvas.tabIndex = 0;
  slider.type = "range";
  [slider.min, slider.max, slider.step, slider.value] = [0, end, 0.01, 0];
  slider.setAttribute("aria-label", "time in seconds");
  speed.setAttribute("aria-label", "speed");
  for (const [factor, text] of [[1, "as fast as it is"], [0.25, "a quarter of it"], [0.1, "a tenth of it"]]) {
    speed.append(Object.assign(element("option", text), { value: factor }));
  }
  controls.append(play, slider, time, speed);
  place.append(canvas, controls, now);

  // the view: what it turns about, and how far away it is
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  const widen = (p) => p.forEach((x, k) => { low[k] = Math.min(low[k], x); high[k] = Math.max(high[k], x); });
  for (const frame of s.ends) for (let k = 0; k < frame.length; k += 3) widen(frame.slice(k, k + 3));
  if (s.floor !== null) widen([0, 0, s.floor]);
  const middle = low.map((x, k) => (x + high[k]) / 2);
  const reach = Math.max(0.2, Math.hypot(...low.map((x, k) => high[k] - x)) / 2);
  const view = { turn: -0.9, tilt: 0.35, far: 2.1 * reach };

  let t = 0, running = false, last = 0;
  const between = (table) => {
    let k = 0;
    while (k < s.t.length - 2 && s.t[k + 1] <= t) k += 1;
    const share = Math.min(1, Math.max(0, (t - s.t[k]) / (s.t[k + 1] - s.t[k] || 1)));
    return table[k].map((x, j) => x + share * (table[k + 1][j] - x));
  };
  const shade = (colour, by) => {
    const parts = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
    return `rgb(${parts.map((x) => Math.round(by > 1 ? x + (255 - x) * (by - 1) : x * by)).join(",")})`;
  };

  const draw = () => {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth || 600, height = Math.round(0.6 * width);
    if (canvas.width !== Math.round(width * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
      canvas.style.height = `${height}px`;
    }
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    const [ct, st, cp, sp] = [Math.cos(view.turn), Math.sin(view.turn), Math.cos(view.tilt), Math.sin(view.tilt)];
    const focus = 1.25 * height;
    const see = (p) => {
      const [x, y, z] = p.map((v, k) => v - middle[k]);
      const ahead = ct * x + st * y;
      const depth = view.far - (cp * ahead + sp * z), size = focus / Math.max(depth, 0.05 * view.far);
      return { x: width / 2 + size * (-st * x + ct * y), y: height / 2 - size * (cp * z - sp * ahead), depth, size };
    };
    const line = (a, b, colour, wide, dash = []) => {
      const [p, q] = [see(a), see(b)];
      g.strokeStyle = colour;
      g.lineWidth = wide;
      g.setLineDash(dash);
      g.beginPath();
      g.moveTo(p.x, p.y);
      g.lineTo(q.x, q.y);
      g.stroke();
      g.setLineDash([]);
    };
    if (s.floor !== null) {
      const step = reach > 1 ? 0.5 : reach > 0.3 ? 0.2 : 0.05, n = Math.ceil(reach / step);
      for (let k = -n; k <= n; k += 1) {
        line([k * step, -n * step, s.floor], [k * step, n * step, s.floor], "#ddd", 1);
        line([-n * step, k * step, s.floor], [n * step, k * step, s.floor], "#ddd", 1);
      }
    }
    const axis = 0.2 * reach;
    [["x", [axis, 0, 0]], ["y", [0, axis, 0]], ["z", [0, 0, axis]]].forEach(([name, tip]) => {
      line([0, 0, 0], tip, "#777", 1.5);
      const p = see(tip);
      g.fillStyle = "#555";
      g.font = "12px sans-serif";
      g.fillText(name, p.x + 3, p.y - 3);
    });
    for (const box of s.boxes) {
      const corner = (k) => [0, 1, 2].map((j) => ((k >> j) & 1 ? box.high[j] : box.low[j]));
      for (let k = 0; k < 8; k += 1) for (let j = 0; j < 3; j += 1) if (!((k >> j) & 1)) line(corner(k), corner(k | (1 << j)), "#888", 1);
    }
    g.strokeStyle = "#999";
    g.lineWidth = 1;
    g.beginPath();
    s.tool.forEach((p, k) => { const v = see(p); if (k) g.lineTo(v.x, v.y); else g.moveTo(v.x, v.y); });
    g.stroke();

    const gaps = s.pairs.length ? between(s.gaps) : [];
    const near = gaps.length ? gaps.indexOf(Math.min(...gaps)) : -1;
    const close = near < 0 ? [] : s.pairs[near].split(" and ");
    // capsules from far to near, each the hull of two discs
    const ends = between(s.ends);
    const capsules = s.names.map((name, k) => {
      const [p, q] = [ends.slice(6 * k, 6 * k + 3), ends.slice(6 * k + 3, 6 * k + 6)].map(see);
      const colour = close.includes(name) ? NEAR : PALETTE[owners.indexOf(name) % PALETTE.length];
      return { p, q, depth: (p.depth + q.depth) / 2, radius: s.radius[k], colour };
    });
    const hull = (p, q, radius, up) => {
      const [r, R] = [radius * p.size, radius * q.size], [x, y] = [q.x - p.x, q.y - p.y], away = Math.hypot(x, y);
      g.beginPath();
      if (away <= Math.abs(R - r)) {
        const one = R > r ? q : p;
        g.arc(one.x, one.y - up * Math.max(r, R), Math.max(r, R), 0, 2 * Math.PI);
        return;
      }
      const along = Math.atan2(y, x), open = Math.acos((r - R) / away);
      g.arc(p.x, p.y - up * r, r, along + open, along - open + 2 * Math.PI);
      g.arc(q.x, q.y - up * R, R, along - open, along + open);
      g.closePath();
    };
    capsules.sort((one, other) => other.depth - one.depth);
    for (const c of capsules) {
      const light = Math.min(1.1, Math.max(0.75, 1 - 0.25 * (c.depth - view.far) / reach));
      hull(c.p, c.q, c.radius, 0);
      g.fillStyle = shade(c.colour, light);
      g.strokeStyle = shade(c.colour, 0.55 * light);
      g.lineWidth = 1.5;
      g.fill();
      g.stroke();
      hull(c.p, c.q, 0.45 * c.radius, 0.7);
      g.fillStyle = "rgba(255,255,255,0.28)";
      g.fill();
    }
    const tip = see(between(s.tool));
    g.fillStyle = "#000";
    g.beginPath();
    g.arc(tip.x, tip.y, 4, 0, 7);
    g.fill();

    time.textContent = `${t.toFixed(2)} s of ${end.toFixed(1)} s`;
    slider.value = t;
    const angles = between(s.q).map((x, k) => `${s.joints[k]} ${x.toFixed(0)}${s.turns[k] ? "°" : " mm"}`);
    const gap = near < 0 ? (s.shaped ? "" : "No shapes: distances are not known.")
      : `Nearest: ${s.pairs[near]}, ${(1000 * gaps[near]).toFixed(0)} mm apart (red).`;
    now.textContent = `${angles.join(", ")}. ${gap}`;
  };

  const tick = (stamp) => {
    if (!running) return;
    if (last) t += (stamp - last) / 1000 * Number(speed.value);
    last = stamp;
    if (t > end) { t = end; stop(); }
    draw();
    if (running) requestAnimationFrame(tick);
  };
  const stop = () => { running = false; last = 0; play.textContent = "Play"; };
  play.addEventListener("click", () => {
    if (running) { stop(); return; }
    if (t >= end) t = 0;
    running = true;
    play.textContent = "Stop";
    requestAnimationFrame(tick);
  });
  slider.addEventListener("input", () => { stop(); t = Number(slider.value); draw(); });
  let held = null;
  canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (e) => {
    if (!held) return;
    view.turn -= 0.01 * (e.clientX - held[0]);
    view.tilt = Math.min(1.5, Math.max(-1.5, view.tilt + 0.01 * (e.clientY - held[1])));
    held = [e.clientX, e.clientY];
    draw();
  });
  const zoom = (by) => { view.far = Math.min(8 * reach, Math.max(0.8 * reach, view.far * by)); draw(); };
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(e.deltaY > 0 ? 1.1 : 1 / 1.1); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const by = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (by) { view.turn += by[0]; view.tilt = Math.min(1.5, Math.max(-1.5, view.tilt + by[1])); draw(); }
    else if (e.key === "+" || e.key === "-") zoom(e.key === "-" ? 1.1 : 1 / 1.1);
    else return;
    e.preventDefault();
  });
  addEventListener("resize", draw);
  draw();
}
