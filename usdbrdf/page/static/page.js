'use strict';
(() => {
  const data = JSON.parse(document.getElementById('data').textContent);
  const $ = (id) => document.getElementById(id);
  const svgNames = new Set(['svg', 'g', 'path', 'circle', 'line', 'polyline', 'text', 'image', 'rect', 'title']);

  /* An element: attributes (on...: listeners), then children, text or elements. */
  function el(tag, attributes = {}, ...children) {
    const made = svgNames.has(tag)
      ? document.createElementNS('http://www.w3.org/2000/svg', tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name.startsWith('on')) made.addEventListener(name.slice(2), value);
      else if (value !== null && value !== undefined && value !== false) {
        made.setAttribute(name, value === true ? '' : value);
      }
    }
    made.append(...children.filter((child) => child !== null && child !== undefined));
    return made;
  }
  const fixed = (value, digits = 2) => (value === null || value === undefined ? '\u2013' : value.toFixed(digits));
  // What rounds to nothing has no sign.
  const percent = (value, digits = 1) => (value === null ? '\u2013' : `${(Number((100 * value).toFixed(digits)) + 0).toFixed(digits)} %`);
  const metres = (value) => `${value.toFixed(2)} m`;
  const STATUS = {
    measured: 'measured', bounded: 'bounded', undetermined: 'not determined', unseen: 'unseen', failed: 'failed', lamp: 'lamp',
    sparse: 'too few pixels', contradicted: 'seen through', pane: 'clear glass', told: 'left out', glimpsed: 'hardly shown',
  };
  const MATERIAL = { dielectric: 'a colour under a gloss', diffuse: 'a colour alone', conductor: 'a metal' };
  // Nothing was fitted of these: the numbers that they carry stand for nothing.
  const UNFITTED = ['lamp', 'pane', 'told'];

  // So many are shown at once; the others, of scans with hundreds of objects, are folded.
  const MOST_WARNINGS = 8;
  // A longer table scrolls by itself: what follows it stays within reach.
  const MOST_ROWS = 40;

  /* --- Capture ------------------------------------------------------------------------------- */

  function capture() {
    const { capture: facts } = data;
    const name = data.published ? `${data.name} ${data.published}` : data.name;
    document.title = `${name}: usdbrdf report`;
    $('title').textContent = name;
    const measured = data.objects.filter((one) => one.status === 'measured').length;
    $('lead').textContent = `${facts.frames} photographs, ${data.objects.length} objects, ${measured} measured`;
    $('findings').append(...data.findings.map((sentence) => el('li', {}, sentence)));
    const warned = (data.warnings || []).map((sentence) =>
      el('p', { class: 'warning' }, el('strong', {}, 'Warning: '), signs(sentence)));
    const first = warned.length > MOST_WARNINGS + 1 ? MOST_WARNINGS : warned.length;
    $('warnings').append(...warned.slice(0, first));
    if (first < warned.length) {
      $('warnings').append(el('details', {}, el('summary', {}, `${warned.length - first} more warnings`), ...warned.slice(first)));
    }
    if (!warned.length) {
      $('warnings').append(el('p', { class: 'soft' }, data.warnings ? 'No warnings.'
        : 'What was warned of is not known here: a published version does not hold it. The page of the asset tells.'));
    }
    const told = [
      ...(facts.lighting ? [['Lighting', facts.lighting]] : []),
      ['Photographs', `${facts.frames}, ${facts.resolution.join(' \u00d7 ')} pixels, ${facts.encoding}`],
      ['Read as', facts.adapter || 'unknown'],
      ['Radiometric', facts.radiometric ? 'yes' : 'no: numbers are relative'],
      ['Surface', `${facts.triangles.toLocaleString('en')} triangles, ${facts.texels.toLocaleString('en')} texels`],
      ['Made by', `usdbrdf ${data.version}`],
    ];
    for (const [name, value] of told) $('facts').append(el('dt', {}, name), el('dd', {}, value));
    plan();
    $('frames').append(
      frameChart('Exposure of the photographs', 'seconds, logarithmic', (row) => row.exposure_s, true),
      frameChart('Clipped pixels', '% of the photograph', (row) => 100 * row.clipped, false),
    );
  }

  function plan() {
    const { map } = data, long = 0.035 * Math.max(map.width, map.height);
    const marks = map.cameras.map(([x, y, dx, dy], i) => {
      const [cx, cy] = [x * map.width, y * map.height];
      return el('g', {},
        el('title', {}, `Frame ${i}`),
        el('line', { x1: cx, y1: cy, x2: cx + long * dx, y2: cy + long * dy, stroke: '#fff', 'stroke-width': 3 }),
        el('line', { x1: cx, y1: cy, x2: cx + long * dx, y2: cy + long * dy, stroke: '#0b5cad', 'stroke-width': 1.5 }),
        el('circle', { cx, cy, r: 3.4, fill: '#ffb000', stroke: '#000', 'stroke-width': 0.8 }));
    });
    marks.push(...map.advised.map(([x, y, dx, dy], i) => {
      const [cx, cy] = [x * map.width, y * map.height];
      return el('g', {},
        el('title', {}, `Advised photograph ${i + 1}`),
        el('line', { x1: cx, y1: cy, x2: cx + 1.6 * long * dx, y2: cy + 1.6 * long * dy, stroke: '#fff', 'stroke-width': 4 }),
        el('line', { x1: cx, y1: cy, x2: cx + 1.6 * long * dx, y2: cy + 1.6 * long * dy, stroke: '#b3261e', 'stroke-width': 2 }),
        el('circle', { cx, cy, r: 8, fill: '#b3261e', stroke: '#fff', 'stroke-width': 1 }),
        el('text', { x: cx, y: cy + 3.6, fill: '#fff', 'font-size': 10, 'text-anchor': 'middle' }, String(i + 1)));
    }));
    $('map').append(
      el('svg', {
        viewBox: `0 0 ${map.width} ${map.height}`, role: 'img', width: map.width,
        'aria-label': `Map of the room from above, with ${map.cameras.length} cameras and the directions they look in`,
      }, el('image', { href: map.picture, width: map.width, height: map.height }), ...marks),
      el('figcaption', {}, `From above, cut at the cameras\u2019 height: ${map.metres.map(metres).join(' \u00d7 ')}. Dots: cameras; lines: where they look.${map.advised.length ? ' Numbers: photographs that are advised.' : ''}`));
  }

  /* What a terminal is told in ASCII, in the signs that it stands for; nothing breaks inside. */
  const signs = (text) => text.replaceAll('+-', '\u00b1').replaceAll(' -> ', ' \u2192\u00a0').replaceAll('m^2', 'm\u00b2');

  function advice() {
    const { advice: found } = data;
    if (!found) {
      $('advised').append(el('p', { class: 'soft' }, 'Nobody asked yet: usdbrdf advise says which photographs would tell most.'));
      return;
    }
    if (!found.current) {
      $('advised').append(el('p', { class: 'warning' }, 'The asset has changed since: ask usdbrdf advise again.'));
    }
    $('advised').append(
      el('p', { class: 'soft' }, 'The most telling first, each with what it adds to those before it. Numbers as on the map.'),
      el('ol', {}, ...found.poses.map((pose) => el('li', {}, el('strong', {}, signs(pose.where)), ' ', signs(pose.reason)))));
  }

  function frameChart(title, unit, value, logarithmic) {
    const points = data.rows.map((row) => [row.number, value(row)]).filter(([, y]) => y !== null);
    return chart(title, unit, [{ name: title, css: 'full', points }], { logarithmic, dots: true });
  }

  /* --- Charts -------------------------------------------------------------------------------- */

  function chart(title, unit, series, { logarithmic = false, dots = false } = {}) {
    // On a narrow screen as wide as it is, so that its text keeps its size.
    const width = matchMedia('(max-width: 600px)').matches ? 340 : 520;
    const [height, left, top, bottom] = [200, 54, 10, 34];
    const all = series.flatMap((one) => one.points).filter(([, y]) => Number.isFinite(y));
    const figure = el('figure');
    figure.append(el('h3', {}, title));
    if (!all.length) { figure.append(el('p', { class: 'soft' }, 'Nothing to show.')); return figure; }
    const shape = logarithmic ? (y) => Math.log10(Math.max(y, 1e-12)) : (y) => y;
    let low = logarithmic ? Math.min(...all.map(([, y]) => shape(y))) : 0;
    let high = Math.max(...all.map(([, y]) => shape(y)));
    if (high - low < 1e-9) { high += logarithmic ? 0.5 : 1; low -= logarithmic ? 0.5 : 0; }
    const last = Math.max(...all.map(([x]) => x), 1);
    const px = (x) => left + (x / last) * (width - left - 8);
    const py = (y) => height - bottom - ((shape(y) - low) / (high - low)) * (height - top - bottom);
    const drawing = el('svg', { viewBox: `0 0 ${width} ${height}`, role: 'img', width: '100%' });
    const digits = (y) => Number(y.toPrecision(2)).toString();
    for (const share of [0, 0.5, 1]) {
      const raw = low + share * (high - low), y = logarithmic ? 10 ** raw : raw;
      drawing.append(
        el('line', { class: 'grid', x1: left, x2: width - 8, y1: py(y), y2: py(y) }),
        el('text', { x: left - 10, y: py(y) + 4, 'text-anchor': 'end' }, digits(y)));
    }
    drawing.append(
      el('text', { x: left, y: height - 6 }, 'frame 0'),
      el('text', { x: width - 8, y: height - 6, 'text-anchor': 'end' }, `frame ${last}`));
    const told = [];
    for (const one of series) {
      const shown = one.points.filter(([, y]) => Number.isFinite(y));
      if (!dots) {
        drawing.append(el('polyline', { class: one.css, points: shown.map(([x, y]) => `${px(x)},${py(y)}`).join(' ') }));
      }
      drawing.append(...shown.map(([x, y]) => el('circle', { class: one.css, cx: px(x), cy: py(y), r: dots ? 3 : 2.4 })));
      const mean = shown.reduce((sum, [, y]) => sum + y, 0) / Math.max(shown.length, 1);
      told.push(`${one.name}: mean ${digits(mean)}, from ${digits(Math.min(...shown.map(([, y]) => y)))} to ${digits(Math.max(...shown.map(([, y]) => y)))}`);
    }
    drawing.setAttribute('aria-label', `${title}, ${unit}, over frames. ${told.join('. ')}`);
    figure.append(drawing);
    const caption = el('figcaption', {}, `${unit}. `);
    if (series.length > 1) {
      caption.append(...series.map((one) => el('span', { class: 'key' },
        el('i', { style: `background: var(--${one.css})` }), one.name)));
    }
    figure.append(caption);
    return figure;
  }

  /* --- Objects ------------------------------------------------------------------------------- */

  const review = new Map(Object.entries(data.review || {}));
  const changed = data.changed || {};
  let unsaved = false;
  // Whether a layer was handed over, which knows nothing of what is said after it.
  let handed = false;
  // What was said on this page since it last saved: others may have said more of the rest by now.
  const said = new Map();
  const VERDICTS = { '': 'none yet', accept: 'accepted', reject: 'rejected' };
  const judged = (prim) => review.get(prim) || { verdict: '', comment: '', directive: '' };
  const encoded = (linear) => {
    const value = Math.min(Math.max(linear, 0), 1);
    return Math.round(255 * (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055));
  };
  const css = (colour) => (colour ? `rgb(${colour.map(encoded).join(' ')})` : 'transparent');
  // Where psi is not known its deviation tells less than what it is below: the guess may be 0.
  const noMoreThan = (one) => (one.psi_upper !== null && one.psi_upper < 0.995 ? `below ${fixed(one.psi_upper)}` : 'up to 1');
  const isGuess = (one) => one.psi !== null && (one.psi_confidence === 'none' || (one.because === 'bounded' && !one.f0));
  const certain = { high: 0, low: 1, none: 2 };
  const order = Object.keys(STATUS);
  const COLUMNS = [
    { name: 'Picture' },
    { name: 'Object', key: (one) => one.label.toLowerCase() },
    { name: 'Status', wide: true, key: (one) => order.indexOf(one.because) },
    { name: 'Colour', wide: true, key: (one) => (one.base_color ? one.base_color[0] + one.base_color[1] + one.base_color[2] : -1) },
    { name: 'Roughness', sign: '\u03c6', key: (one) => one.phi ?? 9 },
    { name: 'Specular', sign: '\u03c8', key: (one) => (one.f0 ? 8 : one.psi ?? 9) },
    { name: 'Sure', wide: true, key: (one) => certain[one.phi_confidence] + certain[one.psi_confidence] },
    { name: 'Evidence', wide: true, key: (one) => one.evidence ?? -1 },
    { name: 'Seen', wide: true, key: (one) => one.seen },
    { name: 'Verdict', wide: true, key: (one) => judged(one.prim).verdict || '~' },
  ];
  const rows = [];

  /* What the words of the trade say, for who judges without them. */
  const WORDS = {
    Status: 'measured: the photographs determine roughness and specular. Bounded: they do not determine both, but tell that highlights are weaker than usual: specular lies below the number that is told. Not determined: no photograph shows a clear enough highlight. Of both, grey numbers are what remains likely. Unseen: no photograph shows enough of the object to measure anything; hardly shown: only together with what is beside it; too few pixels: enough for a colour, not for more. Seen through: its views contradict that it is a surface; clear glass: photographs show the outside through it. Left out: a person said that nothing be fitted, by ignore or glass.',
    Colour: 'the mean of the base colour: what the object reflects to all sides, without highlights and without the light that fell on it.',
    'Roughness \u03c6': 'how wide highlights are: 0 a mirror, 1 matt (alpha of the GGX distribution; the roughness of most renderers is its square root). \u00b1: one standard deviation.',
    'Specular \u03c8': 'how strong they are: 0.5 is usual for wood, paint and plastics, 0 has none (what is mirrored straight ahead is 0.08 \u03c8 of the light). Of metals a colour, F0, takes its place.',
    Sure: 'how far \u03c6 and \u03c8 are to be believed: high, low, or none: a guess.',
    Evidence: 'how much of what changes from view to view the highlight explains: 0 % nothing, 100 % all.',
    Seen: 'the share of the surface that photographs measured; the rest is filled in from around it or, of what is too thin for that, about what its pixels show.',
  };
  const words = (told) => el('dl', { class: 'facts' },
    ...Object.entries(told).flatMap(([word, meaning]) => [el('dt', {}, word), el('dd', {}, meaning)]));

  function objects() {
    $('words').append(words(WORDS));
    const head = $('table').tHead.rows[0];
    COLUMNS.forEach((column, i) => {
      const cell = el('th', { scope: 'col', class: column.wide ? 'wide' : '' });
      if (column.key) {
        const name = column.sign
          ? [el('span', { class: 'word' }, `${column.name} `), column.sign] : [column.name];
        cell.append(el('button', { type: 'button', onclick: () => sort(i) }, ...name));
        cell.setAttribute('aria-sort', 'none');
      } else cell.append(column.name);
      head.append(cell);
    });
    for (const status of order) {
      if (data.objects.some((one) => one.because === status)) {
        $('filter-status').append(el('option', { value: status }, STATUS[status]));
      }
    }
    data.objects.forEach((one, i) => rows.push(row(one, i)));
    $('table').parentElement.classList.toggle('long', rows.length > MOST_ROWS);
    for (const id of ['filter-name', 'filter-status', 'filter-verdict']) $(id).addEventListener('input', filter);
    $('filter').addEventListener('submit', (event) => event.preventDefault());
    $('save').addEventListener('click', save);
    addEventListener('beforeunload', (event) => { if (unsaved) event.preventDefault(); });
    gone();
    sort(2);
    filter();
  }

  function row(one, i) {
    const picture = one.photograph || one.model;
    const swatch = el('span', { class: 'swatch', style: `background: ${css(one.base_color)}` });
    const number = (value, error, guess = false) => {
      if (UNFITTED.includes(one.because)) return ['\u2013'];
      if (guess) return [fixed(value), el('span', { class: 'error' }, `, ${noMoreThan(one)}`)];
      // An error that would read as 0.00 gets another digit, and its number with it.
      const digits = error !== null && error < 0.005 ? 3 : 2;
      const parts = [fixed(value, digits)];
      if (error !== null) parts.push(el('span', { class: 'error' }, ` \u00b1 ${fixed(error, digits)}`));
      return parts;
    };
    const detail = el('tr', { class: 'detail', id: `detail-${i}`, hidden: true }, el('td', { colspan: COLUMNS.length }));
    const opener = el('button', {
      type: 'button', class: 'name', 'aria-expanded': 'false', 'aria-controls': `detail-${i}`,
      onclick: () => open(entry, detail.hidden),
    }, one.label);
    // Of metals F0, a colour, takes the place of psi.
    const specular = one.f0 && one.status !== 'lamp' ? ['metal'] : number(one.psi, one.psi_error, isGuess(one));
    const numberCss = (confidence) => (confidence === 'none' ? 'number guess' : 'number');
    const verdict = el('td', { class: 'wide' });
    const status = (css) => el('span', { class: `status ${one.status} ${css}` }, STATUS[one.because]);
    const main = el('tr', { 'data-prim': one.prim },
      el('td', {}, picture ? el('img', { class: 'crop', src: picture, alt: `${one.label} in frame ${one.frame}` }) : ''),
      el('td', { class: 'named' }, opener, status('small')),
      el('td', { class: 'wide' }, status('')),
      el('td', { class: 'wide' }, one.status === 'lamp' ? 'shines' : swatch),
      el('td', { class: numberCss(one.phi_confidence) }, ...number(one.phi, one.phi_error)),
      el('td', { class: numberCss(one.psi_confidence) }, ...specular),
      el('td', { class: 'wide' }, UNFITTED.includes(one.because) ? '\u2013' : `\u03c6 ${one.phi_confidence}, ${one.f0 ? 'F0' : '\u03c8'} ${one.psi_confidence}`),
      el('td', { class: 'wide number' }, one.evidence === null ? '\u2013' : percent(one.evidence, 0)),
      el('td', { class: 'wide number' }, percent(one.seen, 0)),
      verdict);
    const entry = { one, main, detail, opener, verdict, filled: false };
    $('table').tBodies[0].append(main, detail);
    showVerdict(entry);
    return entry;
  }

  function showVerdict(entry) {
    const { verdict, directive, comment } = judged(entry.one.prim);
    entry.verdict.replaceChildren(
      el('span', { class: `status ${verdict || 'none'}` }, VERDICTS[verdict] || verdict),
      ...(directive ? [el('span', { class: 'soft' }, ` (${directive})`)] : []),
      ...(comment ? [el('span', { class: 'soft' }, ' with a comment')] : []),
      ...(changed[entry.one.prim] ? [el('div', { class: 'soft' }, 'changed since')] : []));
  }

  function open(entry, wanted) {
    if (wanted && !entry.filled) { fill(entry); entry.filled = true; }
    entry.detail.hidden = !wanted;
    entry.opener.setAttribute('aria-expanded', String(wanted));
  }

  function fill(entry) {
    const { one } = entry, cell = entry.detail.cells[0];
    const figure = (src, text) => el('figure', {}, el('img', { src, alt: `${one.label}: ${text}` }), el('figcaption', {}, text));
    const pictures = el('div', {}, el('h3', {}, `Frame ${one.frame ?? '\u2013'}${one.frame !== one.target ? '' : one.material === 'diffuse' ? ', where a highlight would show best' : ', which shows its highlight best'}`),
      el('div', { class: 'pair' },
        one.photograph ? figure(one.photograph, 'photograph') : null,
        one.model ? figure(one.model, 'model') : null));
    if (!one.model) pictures.append(el('p', {}, 'No photograph shows it.'));
    const facts = el('dl', { class: 'facts' });
    const fact = (name, value) => facts.append(el('dt', {}, name), el('dd', {}, value));
    if (one.status === 'lamp' && one.radiance) {
      fact('Radiance', `${one.radiance.mean.map((value) => value.toPrecision(3)).join(', ')} (${one.radiance.status})`);
    } else if (!UNFITTED.includes(one.because)) {
      fact('Roughness \u03c6', `${fixed(one.phi, 3)} \u00b1 ${fixed(one.phi_error, 3)}, confidence ${one.phi_confidence}`);
      if (one.f0) fact('F0 of the metal', one.f0.map((value) => fixed(value, 3)).join(', '));
      else {
        fact('Specular \u03c8', `${fixed(one.psi, 3)} \u00b1 ${fixed(one.psi_error, 3)}, confidence ${one.psi_confidence}`);
        fact('\u03c8 is below', `${fixed(one.psi_upper, 3)} with 95 %`);
      }
      fact('Evidence', one.evidence === null ? '\u2013' : percent(one.evidence));
      if (one.base_color) fact('Base colour', `${one.base_color.map((value) => fixed(value, 3)).join(', ')} (linear)`);
    }
    if (MATERIAL[one.material] && !UNFITTED.includes(one.because) && one.status !== 'unseen') fact('Material', MATERIAL[one.material]);
    fact('Class', one.class || 'none');
    fact('Area', `${one.area.toFixed(2)} m\u00b2, ${percent(one.seen)} seen, ${percent(one.clipped, 2)} clipped everywhere`);
    fact('Prim', one.prim);
    cell.append(el('div', { class: 'inner' },
      el('div', {}, pictures, el('p', {}, one.why), changed[one.prim] ? el('p', { class: 'warning' }, changed[one.prim]) : null),
      el('div', {}, facts),
      el('div', {}, ...evidence(one)),
      judge(entry)));
  }

  /* What lobes leave unexplained of the target frame, over phi and psi. */
  function evidence(one) {
    const told = ['ignore', 'glass'].includes(one.directive);
    const none = one.status === 'lamp' ? 'What shines by itself is not fitted.' : told ? 'Nothing was fitted, by directive.' : one.because === 'pane' ? 'Clear glass is not fitted.' : 'Too few pixels for a plot.';
    if (!one.costs) return [el('h3', {}, 'Evidence'), el('p', { class: 'soft' }, none)];
    const { phis, psis, values } = one.costs;
    const [width, height, left, top, side] = [290, 232, 38, 8, 200];
    let best = [0, 0];
    values.forEach((line, i) => line.forEach((value, j) => { if (value < values[best[0]][best[1]]) best = [i, j]; }));
    const least = values[best[0]][best[1]];
    const most = least + Math.max(0.02, Math.min(1.2, Math.max(...values.flat())) - least);
    const drawing = el('svg', { viewBox: `0 0 ${width} ${height}`, width, role: 'img' });
    const edges = (list) => [0, ...list.slice(1).map((value, k) => (value + list[k]) / 2), 1];
    const [xs, ys] = [edges(phis), edges(psis)];
    const px = (phi) => left + phi * side, py = (psi) => top + (1 - psi) * side;
    values.forEach((line, i) => line.forEach((value, j) => {
      const share = Math.min(Math.max((value - least) / (most - least), 0), 1);
      drawing.append(el('rect', {
        x: px(xs[i]), y: py(ys[j + 1]), width: (xs[i + 1] - xs[i]) * side + 0.5,
        height: (ys[j + 1] - ys[j]) * side + 0.5, fill: ramp(1 - share),
      }));
    }));
    if (one.phi !== null) {
      const spread = (value, error) => [Math.max(value - (error || 0), 0), Math.min(value + (error || 0), 1)];
      const [x1, x2] = spread(one.phi, one.phi_error), [y1, y2] = spread(one.psi, one.psi_error);
      const cross = (colour, thick) => [
        el('line', { x1: px(x1), x2: px(x2), y1: py(one.psi), y2: py(one.psi), stroke: colour, 'stroke-width': thick }),
        el('line', { x1: px(one.phi), x2: px(one.phi), y1: py(y1), y2: py(y2), stroke: colour, 'stroke-width': thick })];
      drawing.append(...cross('#000', 4), ...cross('#fff', 2));
    }
    for (const share of [0, 0.5, 1]) {
      drawing.append(
        el('text', { x: px(share), y: top + side + 16, 'text-anchor': 'middle' }, String(share)),
        el('text', { x: left - 6, y: py(share) + 4, 'text-anchor': 'end' }, String(share)));
    }
    drawing.append(el('text', { x: left + side + 8, y: top + side + 16 }, '\u03c6'), el('text', { x: 4, y: top + 18 }, '\u03c8'));
    drawing.setAttribute('aria-label',
      `Cost over roughness and specular in frame ${one.frame}: least ${fixed(least)} of what no lobe leaves, at phi ${phis[best[0]]} and psi ${psis[best[1]]}; at psi 0 it is ${fixed(values[best[0]][0])}`);
    return [el('h3', {}, 'Evidence of this frame'), drawing, el('p', { class: 'soft' },
      `Bright: lobes that explain this frame best (the best one ${percent(1 - least, 0)} of what is left without any). Cross: the published numbers with their errors, which all frames tell.`)];
  }

  /* Viridis at five steps (CC0), linear in between. */
  function ramp(share) {
    const steps = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
    const k = Math.min(Math.floor(share * 4), 3), t = share * 4 - k;
    return `rgb(${steps[k].map((value, c) => Math.round(value + t * (steps[k + 1][c] - value))).join(' ')})`;
  }

  function sort(index) {
    const cells = [...$('table').tHead.rows[0].cells], cell = cells[index];
    const down = cell.getAttribute('aria-sort') === 'ascending';
    cells.forEach((other) => { if (other.hasAttribute('aria-sort')) other.setAttribute('aria-sort', 'none'); });
    cell.setAttribute('aria-sort', down ? 'descending' : 'ascending');
    const { key } = COLUMNS[index], sign = down ? -1 : 1;
    rows.sort((a, b) => {
      const [x, y] = [key(a.one), key(b.one)];
      return sign * (x < y ? -1 : x > y ? 1 : 0) || a.one.label.localeCompare(b.one.label);
    });
    for (const { main, detail } of rows) $('table').tBodies[0].append(main, detail);
  }

  function filter() {
    const name = $('filter-name').value.toLowerCase(), status = $('filter-status').value;
    const verdict = $('filter-verdict').value;
    let shown = 0;
    for (const entry of rows) {
      const { one } = entry, given = judged(one.prim).verdict;
      const kept = one.label.toLowerCase().includes(name) && (!status || one.because === status)
        && (!verdict || (verdict === 'changed' ? Boolean(changed[one.prim]) : (given || 'none') === verdict));
      entry.main.hidden = !kept;
      entry.detail.hidden = !kept || entry.opener.getAttribute('aria-expanded') !== 'true';
      shown += kept;
    }
    $('count').textContent = `${shown} of ${rows.length} objects`;
  }

  /* --- Verdicts ------------------------------------------------------------------------------ */

  function judge(entry) {
    const { one } = entry, now = judged(one.prim), name = `verdict-${one.id}`;
    const comment = el('textarea', { maxlength: 2000, rows: 3 });
    comment.value = now.comment;
    const directive = el('select', {}, ...['', 'ignore', 'metal', 'glass', 'lamp', 'not-lamp', 'refit']
      .map((word) => el('option', { value: word, selected: word === now.directive }, word || 'none')));
    const choices = [['', 'none yet'], ['accept', 'accept'], ['reject', 'reject']].map(([value, text]) =>
      el('label', {}, el('input', { type: 'radio', name, value, checked: value === now.verdict, onchange: note }), ` ${text}`));
    function note() {
      const chosen = form.querySelector('input:checked').value;
      const words = { verdict: chosen, comment: comment.value.trim(), directive: directive.value };
      const first = (data.review || {})[one.prim];
      // Said again as it was, it was judged then, of what was there then.
      const same = first && Object.keys(words).every((word) => words[word] === first[word]);
      review.set(one.prim, same ? first : words);
      said.set(one.prim, words);
      unsaved = true;
      $('saved').textContent = 'not saved yet';
      showVerdict(entry);
    }
    comment.addEventListener('input', note);
    directive.addEventListener('change', note);
    const form = el('fieldset', {}, el('legend', {}, `Your verdict on ${one.label}`),
      el('div', { class: 'bar' }, ...choices),
      el('label', {}, 'Comment', comment),
      el('label', {}, 'For the next run ', directive));
    return form;
  }

  const there = new Set(data.objects.map((one) => one.prim));
  const saysSomething = (one) => Boolean(one.verdict || one.comment || one.directive);
  const strangers = () => [...review].filter(([prim, now]) => !there.has(prim) && saysSomething(now));

  /* What was said of objects that were taken out of the capture since: no row has it. */
  function gone() {
    const left = Object.entries(data.review || {}).filter(([prim, was]) => !there.has(prim) && saysSomething(was));
    $('gone').replaceChildren(...(left.length ? [
      el('h3', {}, 'Said of objects that are gone'),
      el('p', { class: 'soft' }, 'They were judged once, and the capture has them no more, or under other names. Runs pass them over.'),
      el('ul', {}, ...left.map(([prim, was]) => goneItem(prim, was)))] : []));
  }

  function goneItem(prim, was) {
    const button = el('button', { type: 'button', onclick: () => {
      const now = saysSomething(judged(prim)) ? { verdict: '', comment: '', directive: '' } : was;
      review.set(prim, now);
      if (now === was && !handed) said.delete(prim); else said.set(prim, now);
      unsaved = said.size > 0;
      $('saved').textContent = unsaved ? 'not saved yet' : '';
      show();
    } });
    const item = el('li', {}, el('div', { class: 'bar' },
      el('code', {}, prim),
      was.verdict ? el('span', { class: `status ${was.verdict}` }, VERDICTS[was.verdict] || was.verdict) : null,
      was.directive ? el('span', {}, `for the next run: ${was.directive}`) : null, button),
    was.comment ? el('p', {}, was.comment) : null);
    function show() {
      const kept = saysSomething(judged(prim));
      item.classList.toggle('taken', !kept);
      button.textContent = kept ? 'Take back' : 'Taken back: undo';
      button.setAttribute('aria-label', `${kept ? 'Take back' : 'Taken back: undo of'} what was said of ${prim}`);
    }
    show();
    return item;
  }

  const escaped = (text) => text.replace(/\\/g, '\\\\').replace(/"/g, '\\"').replace(/\r/g, '').replace(/\n/g, '\\n');

  /* The verdicts as the layer review.usda, as usdbrdf itself writes it. */
  function layer() {
    const tree = {};
    for (const one of [...data.objects, ...strangers().map(([prim]) => ({ prim }))]) {
      const now = judged(one.prim), { verdict, comment, directive } = now;
      if (!saysSomething(now)) continue;
      const { status, phi, psi } = 'status' in now ? now : { ...one, status: one.fit };
      let node = tree;
      for (const part of one.prim.split('/').filter(Boolean)) node = (node[part] ??= {});
      node[''] = { verdict, comment, directive, status, phi, psi };
    }
    const write = (node, indent) => Object.entries(node).filter(([name]) => name).map(([name, inner]) => {
      const said = inner[''], pad = ' '.repeat(indent);
      let text = `${pad}over "${name}"`;
      if (said) {
        const lines = Object.entries(said).filter(([, value]) => value !== null && value !== '')
          .map(([key, value]) => (typeof value === 'number'
            ? `double ${key} = ${value}` : `string ${key} = "${escaped(value)}"`));
        text += ` (\n${pad}    customData = {\n${pad}        dictionary usdbrdf = {\n${pad}            dictionary review = {\n`
          + lines.map((line) => `${pad}                ${line}\n`).join('')
          + `${pad}            }\n${pad}        }\n${pad}    }\n${pad})`;
      }
      return `${text}\n${pad}{\n${write(inner, indent + 4)}${pad}}\n`;
    }).join('');
    return `#usda 1.0\n(\n    customLayerData = {\n        dictionary usdbrdf = {\n            string role = "review"\n        }\n    }\n    defaultPrim = "${data.name}"\n)\n\n${write(tree, 0)}`;
  }

  async function save() {
    if (data.served && !data.published) {
      const sent = [...said];
      const answer = await fetch(data.served, {
        method: 'POST', headers: { 'Content-Type': 'application/json' },
        body: JSON.stringify(Object.fromEntries(sent)),
      }).catch(() => null);
      if (!answer || !answer.ok) {
        $('saved').textContent = answer ? `not saved: ${await answer.text()}` : 'not saved: usdbrdf view has ended';
        return;
      }
      $('saved').textContent = 'saved in review.usda';
      for (const [prim, words] of sent) {
        if (said.get(prim) === words) said.delete(prim);
        // Nobody can say anything of it any more.
        if (!there.has(prim) && !saysSomething(words)) delete data.review[prim];
      }
      gone();
      unsaved = said.size > 0;
      return;
    } else {
      const link = el('a', {
        href: URL.createObjectURL(new Blob([layer()], { type: 'text/plain' })), download: 'review.usda',
      });
      link.click();
      handed = true;
      $('saved').textContent = `review.usda was handed to you: put it beside edits.usda${data.published ? ' of the asset that this version was published from' : ''}`;
    }
    unsaved = false;
  }

  /* --- Views --------------------------------------------------------------------------------- */

  const PICTURES = { photograph: 'photograph', baseline: 'diffuse baseline', full: 'full model' };

  function views() {
    const body = $('slider'), all = data.views;
    if (!all.length) { body.append(el('p', {}, 'No views.')); return; }
    const names = Object.keys(PICTURES).filter((name) => all[0][name]);
    const choose = (label, start) => {
      const select = el('select', { onchange: show }, ...names.map((name) => el('option', { value: name, selected: name === start }, PICTURES[name])));
      return [select, el('label', {}, `${label} `, select)];
    };
    const [left, leftLabel] = choose('Left', names[0]), [right, rightLabel] = choose('Right', 'full');
    const view = el('select', { onchange: show, id: 'view' }, ...all.map((one, i) => el('option', { value: i }, title(one))));
    const step = (by) => { view.value = (Number(view.value) + by + all.length) % all.length; show(); };
    const under = el('img', { alt: '' }), over = el('img', { alt: '' });
    const tags = [el('span', { class: 'tag left' }), el('span', { class: 'tag right' })];
    const frame = el('div', { class: 'compare' }, under, el('div', { class: 'over' }, over), el('div', { class: 'edge' }), ...tags);
    const at = el('input', { type: 'range', id: 'at', min: 0, max: 100, value: 50, 'aria-label': 'Where the left picture ends, in percent of the width', oninput: move });
    const flips = el('div', { class: 'flips' }), told = el('p', { class: 'soft' });
    function move() { frame.style.setProperty('--at', `${at.value}%`); }
    frame.addEventListener('pointermove', (event) => {
      if (event.buttons !== 1) return;
      const box = frame.getBoundingClientRect();
      at.value = Math.round((100 * (event.clientX - box.left)) / box.width);
      move();
    });
    frame.addEventListener('dragstart', (event) => event.preventDefault());
    function show() {
      const one = all[view.value];
      over.src = one[left.value]; under.src = one[right.value];
      over.alt = `${title(one)}: ${PICTURES[left.value]}`;
      under.alt = `${title(one)}: ${PICTURES[right.value]}`;
      tags[0].textContent = PICTURES[left.value]; tags[1].textContent = PICTURES[right.value];
      const { row } = one;
      told.textContent = `FLIP ${fixed(row.flip_baseline, 4)} (baseline), ${fixed(row.flip_full, 4)} (full model); relative L2 without lamps ${fixed(row.l2_baseline, 4)} and ${fixed(row.l2_full, 4)}; ${percent(row.compared)} of the pixels are compared.`;
      flips.replaceChildren(...['baseline', 'full'].map((model) => el('figure', {},
        el('img', { src: one[`flip_${model}`], alt: `FLIP error map of the ${PICTURES[model]}, ${title(one)}` }),
        el('figcaption', {}, `FLIP, ${PICTURES[model]}: mean ${fixed(row[`flip_${model}`], 4)}. Black: equal; pale yellow: wrong; grey: not compared.`))));
      move();
    }
    body.append(
      el('div', { class: 'bar' },
        el('label', {}, 'View ', view),
        el('span', { class: 'steps' },
          el('button', { type: 'button', onclick: () => step(-1) }, 'previous'),
          el('button', { type: 'button', onclick: () => step(1) }, 'next')), leftLabel, rightLabel),
      frame, at, told, flips);
    show();
    const line = (metric) => ['baseline', 'full'].map((model) => ({
      name: PICTURES[model], css: model, points: data.plot.map((row) => [row.number, row[`${metric}_${model}`] ?? NaN]),
    }));
    body.append(el('details', {}, el('summary', {}, 'What these words mean'), words({
      'Diffuse baseline': 'the asset without highlights: what each place sends to all sides alike.',
      'Full model': 'the asset as it was measured, highlights included.',
      FLIP: 'how different two pictures look to people who switch between them: 0 equal, 1 the most there is.',
      'Relative L2': 'the error of the radiance, as a share of the photograph\u2019s: 0.05 is 5 %.',
    })));
    $('plots').append(
      chart('Relative L2 over the frames', 'without lamps; small pictures', line('l2')),
      chart('FLIP over the frames', 'mean of small pictures', line('flip')));
  }
  const title = (one) => `frame ${one.row.number}${one.row.view ? `, ${one.row.view}` : ''}`;

  /* --- Maps ---------------------------------------------------------------------------------- */

  function maps() {
    data.maps.forEach((map, i) => $('map-name').append(el('option', { value: i }, map.title)));
    data.maps[0].pictures.forEach((_, i) => $('map-view').append(
      el('option', { value: i }, data.views[i] ? title(data.views[i]) : `view ${i + 1}`)));
    const show = () => {
      const map = data.maps[$('map-name').value];
      $('map-picture').src = map.pictures[$('map-view').value];
      $('map-picture').alt = `${map.title}, as seen in ${$('map-view').selectedOptions[0].textContent}`;
      $('map-legend').textContent = map.legend;
    };
    $('map-name').addEventListener('change', show);
    $('map-view').addEventListener('change', show);
    show();
  }

  /* --- Room ---------------------------------------------------------------------------------- */

  function colours() {
    const status = { measured: [0, 0.34, 0.17], bounded: [0.09, 0.46, 0.81], undetermined: [0.79, 0.35, 0], unseen: [0.3, 0.3, 0.3], failed: [0.66, 0.11, 0], lamp: [0.87, 0.77, 0.05] };
    const verdicts = { accept: [0, 0.34, 0.17], reject: [0.66, 0.11, 0] };
    const number = (value) => (value === null ? [0.3, 0, 0.3]
      : ramp(value).match(/\d+/g).map((byte) => (Number(byte) / 255) ** 2.2));
    const of = (get) => Object.fromEntries(data.objects.map((one) => [one.prim, get(one)]));
    return {
      status: of((one) => status[one.status]), phi: of((one) => number(one.phi)), psi: of((one) => number(one.psi)),
      get verdict() { return of((one) => verdicts[judged(one.prim).verdict] || [0.3, 0.3, 0.3]); },
    };
  }

  async function room() {
    const body = $('room-body');
    const fallback = (why) => {
      body.replaceChildren(el('p', {}, why), el('p', {}, 'Pictures instead:'),
        el('div', { class: 'flips' }, ...data.views.slice(0, 4).map((one) =>
          el('figure', {}, el('img', { src: one.full, alt: `Full model, ${title(one)}` }), el('figcaption', {}, title(one))))));
      body.dataset.state = 'pictures';
    };
    if (!data.room) { fallback('This page was made without a model of the room.'); return; }
    const probe = document.createElement('canvas');
    if (!(probe.getContext('webgl2') && window.DecompressionStream)) {
      fallback('This browser shows no 3D (WebGL 2).');
      return;
    }
    const canvas = el('canvas', {
      tabindex: 0, role: 'application',
      'aria-label': 'The room in 3D. Arrow keys turn, plus and minus come closer and go away, Enter picks what is in the middle.',
    });
    const picked = el('div', { class: 'picked', role: 'status' });
    const pick = (prim) => {
      const one = data.objects.find((other) => other.prim === prim);
      picked.textContent = !one ? '' : UNFITTED.includes(one.because) ? `${one.label}: ${STATUS[one.because]}`
        : `${one.label}: ${STATUS[one.because]}, \u03c6 ${fixed(one.phi)} \u00b1 ${fixed(one.phi_error)}, ${one.f0
          ? `metal, F0 ${one.f0.map((value) => fixed(value)).join(', ')}` : `\u03c8 ${fixed(one.psi)}${isGuess(one) ? `, ${noMoreThan(one)}` : ` \u00b1 ${fixed(one.psi_error)}`}`}`;
      canvas.dataset.picked = one ? one.prim : '';
    };
    let model;
    try { model = await usdbrdfRoom.start(canvas, data.room, colours(), pick); } catch (error) {
      fallback(`The room cannot be shown in 3D here (${error.message}).`);
      return;
    }
    window.usdbrdfModel = model;
    const { outside } = data.room;
    const box = (label, change) => el('label', {},
      el('input', { type: 'checkbox', checked: true, onchange: (event) => change(event.target.checked) }), ` ${label}`);
    const lamps = data.room.lamps.map((lamp, i) => box(lamp.label, (shines) => model.setLamp(i, shines)));
    const sources = ['sky', 'sun'].filter((name) => outside && outside[name]);
    const daylight = sources.map((name) => {
      const { error } = outside[name];
      return box(error === null ? name : `${name} \u00b1 ${percent(error, 0)}`, (shines) => model.setOutside(name, shines));
    });
    const looks = { shaded: `lit by ${[...(lamps.length || !outside ? ['its lamps'] : []), ...(outside ? ['daylight'] : [])].join(' and ')}`, lit: 'as photographed', base_color: 'base colour', phi: 'roughness \u03c6', psi: 'specular \u03c8', status: 'what is known', verdict: 'verdicts' };
    const numbers = 'One colour per object. Dark violet: 0; yellow: 1; purple: no number.';
    const legends = {
      phi: numbers, psi: numbers,
      status: data.maps.find((map) => map.name === 'status')?.legend,
      verdict: 'Green: accepted. Red: rejected. Grey: none yet.',
    };
    const legend = el('p', { class: 'soft', id: 'look-legend', role: 'status' });
    const look = el('select', {
      id: 'look',
      onchange: () => { model.setLook(look.value); legend.textContent = legends[look.value] || ''; },
    },
      ...Object.entries(looks).map(([value, text]) => el('option', { value }, text)));
    const range = (label, value, max = 1) => {
      const input = el('input', { type: 'range', min: 0, max, step: 0.01, value, oninput: moved });
      return [input, el('label', {}, `${label} `, input)];
    };
    const [[strength, a], [x, b], [y, c], [z, d]] = [range('strength', 0, 2), range('left to right', 0.5), range('height', 0.7), range('near to far', 0.5)];
    function moved() { model.moveLight(Number(x.value), Number(y.value), Number(z.value), Number(strength.value)); }
    body.append(
      el('div', { class: 'bar' }, el('label', {}, 'Look ', look), el('button', { type: 'button', onclick: () => model.home() }, 'back to the start')),
      el('div', { class: 'stage' }, canvas, picked),
      legend,
      el('p', { class: 'soft' }, `Drag to turn, scroll to come closer, click an object for its numbers. Light that surfaces send on to each other${outside && outside.sky ? ' and that of the sky are' : ' is'} one constant here: pictures of relight are exact.`),
      el('fieldset', {}, el('legend', {}, 'Captured lamps'), el('div', { class: 'bar' }, ...(lamps.length ? lamps : ['None was found.']))),
      daylight.length ? el('fieldset', {}, el('legend', {}, outside.estimated ? 'Daylight, as estimated' : 'Daylight, as given'), el('div', { class: 'bar' }, ...daylight)) : '',
      el('fieldset', {}, el('legend', {}, 'A light of your own'), el('div', { class: 'bar' }, a, b, c, d)));
    body.dataset.state = 'model';
  }

  function carries() {
    const told = [
      data.photographs
        ? `Photographs: ${data.objects.filter((one) => one.photograph).length} parts around objects and ${data.views.length} whole ones, reduced, without metadata such as EXIF or places; their file names.`
        : 'No photograph and no name of one. What was measured from them, such as textures and the model\u2019s pictures, may still show what they show.',
      `Pictures made from the asset: ${data.views.length} views by two models with error maps, ${data.maps.length} maps, ${data.objects.length} objects, a map of the room.`,
      data.room ? `The room as geometry with its textures (glTF), and its lamps${data.room.outside ? ' and daylight' : ''}.` : 'No geometry.',
      'Names of objects and prims, numbers with their errors, verdicts and comments.',
      'No path of the computer that it was made on, and no address: nothing is loaded when it is opened.',
    ];
    $('carries').append(...told.map((sentence) => el('li', {}, sentence)));
  }

  capture();
  advice();
  objects();
  views();
  maps();
  carries();
  room().finally(() => { document.body.dataset.ready = 'yes'; });
})();
