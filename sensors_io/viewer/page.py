"""The page of the live view: pictures as MJPEG, numbers as server-sent events, no library."""

PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>touch: live</title>
<meta name="viewport" content="width=device-width">
<style>
  body { margin: 1rem; background: #14171a; color: #d9dee3; font: 14px system-ui, sans-serif }
  main { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 1rem }
  figure { margin: 0 } figcaption { padding: .3rem 0; color: #9aa4ae }
  img, canvas { width: 100%; background: #000; image-rendering: pixelated }
  table { border-collapse: collapse } td { padding: .1rem .8rem .1rem 0 } td + td { text-align: right }
  .alarm { color: #ff8f6b; font-weight: 600 }
</style>
<h1 id="title">touch</h1>
<main id="panels">
  <figure><canvas id="chart" width="640" height="320"></canvas>
    <figcaption>force, N: x red, y green, −z blue; 10 s</figcaption></figure>
  <figure><table id="numbers"></table><figcaption id="state">waiting for the first sample</figcaption></figure>
</main>
<script>
const shown = new Set(), history = [], span = 10;
const el = (tag, more) => Object.assign(document.createElement(tag), more);
function addPanel(name) {
  shown.add(name);
  const figure = el('figure');
  const picture = el('img', {src: '/panel/' + encodeURIComponent(name), alt: name});
  figure.append(picture, el('figcaption', {textContent: name}));
  document.getElementById('panels').prepend(figure);
}
function draw() {
  const canvas = document.getElementById('chart'), c = canvas.getContext('2d'), now = history.at(-1)[0];
  const top = Math.max(1, ...history.flatMap(h => h[1].map(Math.abs)));
  c.clearRect(0, 0, canvas.width, canvas.height);
  c.fillStyle = '#9aa4ae'; c.fillText(top.toFixed(1), 4, 12); c.fillText('0', 4, canvas.height / 2 - 4);
  c.fillRect(0, canvas.height / 2, canvas.width, 1);
  ['#e06c6c', '#7fbf7f', '#6ca6e0'].forEach((colour, k) => {
    c.strokeStyle = colour; c.beginPath();
    for (const [t, f] of history)
      c.lineTo(canvas.width * (1 - (now - t) / span), canvas.height / 2 * (1 - (k == 2 ? -f[k] : f[k]) / top));
    c.stroke();
  });
}
const source = new EventSource('/numbers');
source.onerror = () => { document.getElementById('state').textContent = 'the view has ended'; };
source.onmessage = event => {
  const s = JSON.parse(event.data);
  document.getElementById('title').textContent = s.title;
  document.getElementById('state').textContent = s.alarm || '';
  document.getElementById('state').className = s.alarm ? 'alarm' : '';
  s.panels.filter(name => !shown.has(name)).forEach(addPanel);
  const table = document.getElementById('numbers');
  table.replaceChildren(...Object.entries(s.numbers).map(([name, value]) => {
    const row = el('tr');
    row.append(el('td', {textContent: name}), el('td', {textContent: value}));
    return row;
  }));
  if (s.force_n) {
    history.push([s.time_s, s.force_n]);
    while (history[0][0] < s.time_s - span) history.shift();
    draw();
  }
};
</script></html>
"""
