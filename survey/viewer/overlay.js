// Compass, scale bar, legend, the coordinates under the pointer and an overview, over the scene of viser; see page.py.
(() => {
  const box = document.createElement("div");
  box.id = "bathynerf-overlay";
  box.style.cssText =
    "position:fixed;z-index:5;pointer-events:none;display:none;flex-wrap:wrap;align-items:flex-end;gap:4px 14px;padding:6px 10px;" +
    "border-radius:6px;background:rgba(255,255,255,0.82);color:#22303c;font:12px/1.35 sans-serif;white-space:pre";
  box.innerHTML =
    '<svg width="34" height="34" viewBox="-17 -17 34 34"><g><path d="M0-15 5 3H-5Z" fill="#c3140d"/>' +
    '<path d="M0 15 5 3H-5Z" fill="#9aa5ad"/><text y="1" font-size="9" text-anchor="middle" fill="#fff">N</text></g></svg>' +
    '<div><div style="height:6px;border:solid #22303c;border-width:0 1.5px 1.5px"></div><span></span></div>' +
    '<div><div style="height:8px"></div><span></span></div><div></div>';
  const needle = box.querySelector("g"), [, scale, legend, place] = box.children;
  const [bar, label] = scale.children;
  const map = document.createElement("div");
  map.id = "bathynerf-overview";
  map.title = "click: look there";
  map.style.cssText =
    "position:fixed;z-index:5;display:none;padding:5px;border-radius:6px;background:rgba(255,255,255,0.82);cursor:crosshair";
  map.innerHTML =
    '<img style="display:block;width:170px;max-height:240px"><svg viewBox="0 0 1 1" preserveAspectRatio="none" style="position:absolute;left:5px;top:5px">' +
    '<polygon fill="none" stroke="#c3140d" stroke-width="1.5" vector-effect="non-scaling-stroke"/></svg>';
  const [picture, frame] = map.children;
  picture.onload = () => {
    frame.setAttribute("width", picture.width);
    frame.setAttribute("height", picture.height);
  };
  map.onclick = (event) => {
    const [x, y] = [event.offsetX / picture.width, 1 - event.offsetY / picture.height];
    if (event.target !== map) ask(`&to_x=${x}&to_y=${y}`);
  };
  let drawnFor = null;
  let at = [0.5, -1], number = null, busy = false, last = 0;

  function show(found, canvas) {
    if (found.azimuth_deg === undefined) return;
    needle.setAttribute("transform", `rotate(${-found.azimuth_deg})`);
    const metresPerPixel = (found.m_per_px * found.height_px) / canvas.height;
    const most = 140 * metresPerPixel, power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((step) => step * power).find((value) => value <= most);
    bar.style.width = `${length / metresPerPixel}px`;
    label.textContent = length >= 1 ? `${length} m` : `${Math.round(length * 1000) / 10} cm`;
    place.textContent = found.place;
    legend.style.display = found.legend.label ? "block" : "none";
    legend.children[0].style.background = `linear-gradient(90deg,${found.legend.colours.map((rgb) => `rgb(${rgb})`)})`;
    legend.children[1].textContent = found.legend.label;
    box.style.cssText += `;display:flex;box-sizing:border-box;max-width:${canvas.width - 24}px;left:${canvas.left + 12}px;bottom:${innerHeight - canvas.bottom + 12}px`;
    frame.children[0].setAttribute("points", found.ground.map(([x, y]) => `${x},${1 - y}`).join(" "));
    map.style.cssText += `;display:block;right:${innerWidth - canvas.right + 12}px;top:${canvas.top + 12}px`;
    const wanted = `${found.revision} ${found.legend.label}`;
    if (drawnFor !== wanted) drawMap(wanted);
  }

  async function drawMap(wanted) {
    const before = drawnFor;
    drawnFor = wanted;
    try {
      picture.src = `data:image/png;base64,${await (await fetch("overview")).json()}`;
    } catch {
      drawnFor = before;
    }
  }

  async function ask(more = "") {
    const canvas = document.querySelector("canvas");
    number = document.querySelector(".bathynerf-browser")?.dataset.number ?? number;
    if ((busy && !more) || document.hidden || !canvas || number === null) return;
    busy = true;
    last = performance.now();
    try {
      const answer = await fetch(`here?number=${number}&x=${at[0]}&y=${at[1]}${more}`);
      if (answer.ok) show(await answer.json(), canvas.getBoundingClientRect());
    } finally {
      busy = false;
    }
  }

  function moved(event) {
    const canvas = document.querySelector("canvas")?.getBoundingClientRect();
    if (canvas) at = [(event.clientX - canvas.left) / canvas.width, (event.clientY - canvas.top) / canvas.height];
    if (performance.now() - last > 120) ask();
  }

  addEventListener("pointermove", moved, true);
  addEventListener("wheel", moved, true);
  setInterval(() => ask(), 1000);
  document.body.append(box, map);
})();
