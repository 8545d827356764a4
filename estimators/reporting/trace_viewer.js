// Measured against model, to be zoomed: buttons, or once the picture was clicked the wheel; dragging moves, a double click shows
// all. Needs nothing but the page that it stands in.
document.querySelectorAll(".viewer").forEach(box => {
  const traces = JSON.parse(box.querySelector("script").textContent);
  const make = (name, parent, attributes = {}, ns = "") => {
    const node = ns ? document.createElementNS(ns, name) : document.createElement(name);
    for (const key in attributes) node.setAttribute(key, attributes[key]);
    return parent.appendChild(node);
  };
  const bar = make("div", box, {class: "bar"}), SVG = "http:" + "//www.w3.org/2000/svg";
  const which = make("select", bar, {"aria-label": "experiment and channel"});
  traces.forEach((t, i) => { make("option", which, {value: i}).textContent = t.name; });
  const what = make("select", bar, {"aria-label": "signals or residuals"});
  ["signals", "residuals"].forEach(word => { make("option", what, {value: word}).textContent = word; });
  const svg = make("svg", box, {role: "img", tabindex: 0}, SVG), legend = make("div", box, {class: "legend"});
  const colours = ["#999", "#e6550d", "#08306b", "#31a354", "#756bb1"], left = 56, top = 24, bottom = 34, height = 316;
  let from = 0, to = 1, width = 600;
  const nice = span => { const p = 10 ** Math.floor(Math.log10(span / 4)); return p * [1, 2, 5, 10].find(f => span / (p * f) < 6); };
  const draw = () => {
    const t = traces[which.value], n = t.series[0].values.length;
    width = Math.max(box.clientWidth, 240);
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.replaceChildren(); legend.replaceChildren();
    const measured = t.series[0].values, rest = what.value === "residuals";
    const shown = t.series.map((s, i) => ({...s, colour: colours[i % 5]})).slice(rest ? 1 : 0).map(s => rest ?
      {...s, values: s.values.map((v, i) => v === null || measured[i] === null ? null : measured[i] - v)} : s);
    const first = Math.max(0, Math.floor(from * (n - 1))), last = Math.min(n - 1, Math.ceil(to * (n - 1)));
    let low = Infinity, high = -Infinity;
    shown.forEach(s => { for (let i = first; i <= last; i++) { const v = s.values[i]; if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); } } });
    if (!(high > low)) { low -= 1; high = low + 2; }
    const gap = 0.05 * (high - low), w = width - left - 8, h = height - bottom - top;
    low -= gap; high += gap;
    const x = i => left + w * (i / (n - 1) - from) / (to - from), y = v => top + h * (high - v) / (high - low);
    const tick = (px, py, text, anchor) => { make("text", svg, {x: px, y: py, "text-anchor": anchor, class: "tick"}, SVG).textContent = text; };
    const t0 = t.start + from * (n - 1) * t.step, t1 = t.start + to * (n - 1) * t.step, ds = nice(t1 - t0), dv = nice(high - low);
    for (let s = Math.ceil(t0 / ds) * ds; s <= t1; s += ds) {
      const px = left + w * (s - t0) / (t1 - t0);
      make("line", svg, {x1: px, x2: px, y1: top, y2: top + h, class: "grid"}, SVG); tick(px, top + h + 14, +s.toPrecision(6), "middle");
    }
    for (let v = Math.ceil(low / dv) * dv; v <= high; v += dv) {
      make("line", svg, {x1: left, x2: left + w, y1: y(v), y2: y(v), class: "grid"}, SVG);
      tick(left - 4, y(v) + 4, +(Math.abs(v) < 1e-9 * dv ? 0 : v).toPrecision(4), "end");
    }
    tick(left + w / 2, height - 4, "Time [s]", "middle"); tick(4, 15, `[${t.unit}]`, "start");
    shown.forEach(s => { // of the samples in each column of pixels the first, the least, the largest and the last
      let path = "", pen = false;
      const by = Math.max(1, Math.floor((last - first) / (2 * w)));
      for (let i = first; i <= last; i += by) {
        const part = [];
        for (let k = i; k < Math.min(i + by, last + 1); k++) if (s.values[k] !== null) part.push(k);
        if (!part.length) { pen = false; continue; }
        const least = part.reduce((a, b) => s.values[b] < s.values[a] ? b : a), most = part.reduce((a, b) => s.values[b] > s.values[a] ? b : a);
        [...new Set([part[0], least, most, part[part.length - 1]])].sort((a, b) => a - b).forEach(k => {
          path += `${pen ? "L" : "M"}${x(k).toFixed(1)} ${y(s.values[k]).toFixed(1)}`; pen = true;
        });
      }
      make("path", svg, {d: path, stroke: s.colour, fill: "none", "stroke-width": s.label === "measured" ? 2.4 : 1.2}, SVG);
      make("span", legend, {style: `border-color:${s.colour}`}).textContent = s.label;
    });
  };
  const zoom = (factor, about = 0.5) => {
    const span = Math.min(1, Math.max(20 / traces[which.value].series[0].values.length, (to - from) * factor)), at = from + about * (to - from);
    from = Math.min(Math.max(0, at - about * span), 1 - span); to = from + span; draw();
  };
  const pan = part => { const span = to - from; from = Math.min(Math.max(0, from + part * span), 1 - span); to = from + span; draw(); };
  const all = () => { from = 0; to = 1; draw(); };
  [["+", () => zoom(0.5)], ["−", () => zoom(2)], ["◀", () => pan(-0.4)], ["▶", () => pan(0.4)], ["all", all]].forEach(([word, act]) => {
    const button = make("button", bar, {type: "button"}); button.textContent = word; button.onclick = act;
  });
  const inside = e => Math.min(1, Math.max(0, ((e.clientX - svg.getBoundingClientRect().left) - left) / (width - left - 8)));
  svg.addEventListener("wheel", e => { if (document.activeElement !== svg) return; e.preventDefault(); zoom(e.deltaY < 0 ? 0.8 : 1.25, inside(e)); }, {passive: false});
  let held = null;
  svg.onpointerdown = e => { held = inside(e); svg.setPointerCapture(e.pointerId); };
  svg.onpointermove = e => { if (held !== null) { const at = inside(e); pan(held - at); held = at; } };
  svg.onpointerup = svg.onpointercancel = () => { held = null; };
  svg.ondblclick = all; which.onchange = all; what.onchange = draw;
  addEventListener("resize", draw); draw();
});
