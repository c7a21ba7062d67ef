// Bundles room.js with three.js into the page's folder, with the licence of what is inside.
import { build } from 'esbuild';
import { readFileSync, writeFileSync } from 'node:fs';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';

const here = dirname(fileURLToPath(import.meta.url));
const to = join(here, '..', 'usdbrdf', 'page', 'static');
const three = join(here, 'node_modules', 'three');
await build({
  entryPoints: [join(here, 'room.js')],
  outfile: join(to, 'room.bundle.js'),
  bundle: true,
  minify: true,
  format: 'iife',
  globalName: 'usdbrdfRoom',
  target: 'es2022',
  charset: 'ascii',
  legalComments: 'none',
});
const { version } = JSON.parse(readFileSync(join(three, 'package.json'), 'utf-8'));
const licence = readFileSync(join(three, 'LICENSE'), 'utf-8').trim();
writeFileSync(join(to, 'room.bundle.LICENCE.txt'), `three.js ${version}\n\n${licence}\n`);
