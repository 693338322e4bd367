// a button beside each block copies it
for (const block of document.querySelectorAll('pre')) {
  const button = document.createElement('button');
  button.textContent = 'Copy';
  button.onclick = async () => {
    getSelection().selectAllChildren(block);
    try { await navigator.clipboard.writeText(block.textContent); } catch { document.execCommand('copy'); }
    button.textContent = 'Copied';
    setTimeout(() => { button.textContent = 'Copy'; }, 1500);
  };
  block.before(button);
}
// a turn's view in space is dragged round; its arrow keys do the same
for (const view of document.querySelectorAll('svg.space')) {
  const {width, height} = view.viewBox.baseVal;
  const parts = [...view.querySelectorAll('path')].map(path =>
    [path, path.dataset.xyz.split(' ').map(Number), Number(path.dataset.run)]);
  let round = 0, tilt = 50;
  const turn = (across, down) => {
    round += across;
    tilt = Math.min(90, Math.max(0, tilt + down));
    const [s, c, up, ahead] = [Math.sin(round / 57.3), Math.cos(round / 57.3),
                               Math.cos(tilt / 57.3), Math.sin(tilt / 57.3)];
    for (const [path, xyz, run] of parts) {
      let d = '';
      for (let n = 0; n < xyz.length; n += 3) {
        const [x, y, z] = xyz.slice(n, n + 3);
        d += (n / 3 % run ? 'L' : 'M') + (width / 2 + c * x - s * y).toFixed(1) + ' '
          + (height / 2 - ahead * (s * x + c * y) - up * z).toFixed(1) + (run > 1 ? '' : 'h0');
      }
      path.setAttribute('d', d);
    }
  };
  const keys = {ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, -5], ArrowDown: [0, 5]};
  view.tabIndex = 0;
  view.onpointerdown = event => view.setPointerCapture(event.pointerId);
  view.onpointermove = event => { if (event.buttons) turn(event.movementX / 2, event.movementY / 2); };
  view.onkeydown = event => {
    if (event.key in keys) { turn(...keys[event.key]); event.preventDefault(); }
  };
}
