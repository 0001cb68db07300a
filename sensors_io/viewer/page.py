"""The page of the live view: pictures asked for one by one, numbers as server-sent events, no library."""

PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>touch: live</title>
<meta name="viewport" content="width=device-width">
<style>
  :root { --ink: #e6eaee; --soft: #98a3ad; --line: #2b3137; --back: #14171a; --card: #1b1f23 }
  * { box-sizing: border-box }
  body { margin: 0; background: var(--back); color: var(--ink); font: 15px/1.4 system-ui, sans-serif }
  header { padding: .8rem 1rem .4rem; display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; align-items: baseline }
  h1 { margin: 0; font-size: 1.15rem; font-weight: 600 }
  #prompt { font-size: 1.3rem; font-weight: 600; color: #8fd0a0 }
  #alarm { margin: .3rem 1rem; padding: .5rem .8rem; border-radius: 6px; background: #7a2323; font-weight: 600 }
  #alarm:empty { display: none }
  main { display: grid; grid-template-columns: minmax(0, 1fr) 360px; gap: 1rem; padding: .6rem 1rem 1rem }
  #panels { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 1rem }
  #panels, aside { align-content: start; align-items: start }
  figure, section { margin: 0; background: var(--card); border: 1px solid var(--line) }
  figure, section { border-radius: 8px; overflow: hidden }
  figcaption, h2 { margin: 0; padding: .4rem .7rem; font-size: .9rem; font-weight: 600 }
  figcaption span { color: var(--soft); font-weight: 400 }
  img { display: block; width: 100%; background: #000; image-rendering: pixelated }
  canvas { display: block; width: 100%; height: 190px }
  aside, #tables { display: grid; gap: 1rem }
  table { border-collapse: collapse; width: 100%; margin-bottom: .4rem; font-variant-numeric: tabular-nums }
  td { padding: .12rem .7rem; vertical-align: top } td:first-child { color: var(--soft); white-space: nowrap }
  td + td { text-align: right }
  i { font-style: normal; margin-left: .8rem }
  @media (max-width: 760px) { main { grid-template-columns: minmax(0, 1fr) } }
</style>
<header><h1 id="title">touch</h1><div id="prompt"></div></header>
<div id="alarm">waiting for the first sample</div>
<main>
  <div id="panels"></div>
  <aside>
    <section id="force" hidden>
      <h2>force, N <i style="color:#f07b7b">x</i><i style="color:#86c986">y</i><i style="color:#79b3f2">−z</i></h2>
      <canvas id="chart"></canvas>
    </section>
    <div id="tables"></div>
  </aside>
</main>
<script>
const $ = id => document.getElementById(id), shown = new Map(), past = [], span = 10;
const el = (tag, more, ...inside) => {
  const e = Object.assign(document.createElement(tag), more);
  e.append(...inside);
  return e;
};
function addPanel(name, caption) {
  const picture = el("img", {alt: name});
  const words = el('figcaption', {}, name + ' ', el('span', {textContent: caption || ''}));
  shown.set(name, el('figure', {}, picture, words));
  $('panels').append(shown.get(name));
}
function refresh(name, version) {
  const picture = shown.get(name).querySelector("img");
  if (!picture.complete) return;  // still on its way: skip one instead of falling behind
  picture.src = "/panel/" + encodeURIComponent(name) + "?" + version;
}
function niceTop(x) {
  const unit = 10 ** Math.floor(Math.log10(x));
  return unit * [1, 2, 5, 10].find(k => k * unit >= x);
}
function draw() {
  const canvas = $('chart'), dpr = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  canvas.width = w * dpr; canvas.height = h * dpr;
  const c = canvas.getContext('2d'), now = past.at(-1)[0], left = 40, right = w - 8, up = 10, down = h - 22;
  c.scale(dpr, dpr); c.font = '12px system-ui, sans-serif';
  const values = past.flatMap(p => [p[1][0], p[1][1], -p[1][2]]);
  const least = Math.min(...values), top = niceTop(Math.max(1, ...values));
  const low = least < -.02 * top ? -niceTop(-least) : 0;
  const y = v => down - (v - low) / (top - low) * (down - up), x = t => right - (now - t) / span * (right - left);
  c.strokeStyle = '#2b3137'; c.fillStyle = '#98a3ad'; c.textAlign = 'right'; c.textBaseline = 'middle';
  for (const v of [low, 0, top / 2, top].filter((v, k, all) => all.indexOf(v) === k)) {
    c.beginPath(); c.moveTo(left, y(v)); c.lineTo(right, y(v)); c.stroke();
    c.fillText(+v.toPrecision(3), left - 6, y(v));
  }
  c.textAlign = 'center';
  for (const s of [0, 5, 10])
    c.fillText(s ? `−${s} s` : "now", Math.min(Math.max(x(now - s), left + 14), right - 12), h - 9);
  ['#f07b7b', '#86c986', '#79b3f2'].forEach((colour, k) => {
    c.strokeStyle = colour; c.lineWidth = 1.5; c.beginPath();
    for (const [t, f] of past) c.lineTo(x(t), y(k == 2 ? -f[k] : f[k]));
    c.stroke();
  });
}
const source = new EventSource('/numbers');
source.onerror = () => {
  const refused = source.readyState == EventSource.CLOSED;
  $('alarm').textContent = refused ? 'no more connections: close other tabs, load again' : 'the view has ended';
};
source.onmessage = event => {
  const s = JSON.parse(event.data);
  $('title').textContent = document.title = s.title;
  $('prompt').textContent = s.prompt; $('alarm').textContent = s.alarm;
  s.panels.filter(name => !shown.has(name)).forEach(name => addPanel(name, s.captions[name]));
  for (const [name, figure] of shown)
    if (!s.panels.includes(name)) { figure.remove(); shown.delete(name); }
  s.panels.forEach(name => refresh(name, s.version));
  $("tables").replaceChildren(...Object.entries(s.tables).map(([name, rows]) => {
    const lines = Object.entries(rows).map(([k, v]) =>
      el("tr", {}, el("td", {textContent: k}), el("td", {textContent: v})));
    return el("section", {}, el("h2", {textContent: name}), el("table", {}, ...lines));
  }));
  if (s.force_n) {
    $('force').hidden = false;
    past.push([s.time_s, s.force_n]);
    while (past[0][0] < s.time_s - span) past.shift();
    draw();
  }
};
</script></html>
"""
