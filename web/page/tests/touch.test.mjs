// The page under fingers, at a phone's width: by Chromium's emulation of touch.

import assert from 'node:assert/strict';
import { after, test } from 'node:test';
import { opened, quit, show, until } from './browser.mjs';

after(quit);

const PHONE = { size: { width: 390, height: 844 }, more: { hasTouch: true, isMobile: true } };
const VIEWS = ['summary', 'trace', 'graphs', 'fixed', 'bits', 'statistics', 'conversations', 'notes'];

/** Gestures as fingers make them: each step has the places of all of them. */
async function fingers(page, steps) {
  const cdp = await page.context().newCDPSession(page);
  const points = (step) => step.map(([x, y], id) => ({ x, y, id }));
  await cdp.send('Input.dispatchTouchEvent', { type: 'touchStart', touchPoints: points(steps[0]) });
  for (const step of steps.slice(1)) await cdp.send('Input.dispatchTouchEvent', { type: 'touchMove', touchPoints: points(step) });
  await cdp.send('Input.dispatchTouchEvent', { type: 'touchEnd', touchPoints: [] });
}

const line = (from, to, count = 10) => Array.from({ length: count + 1 }, (_, i) => from + ((to - from) * i) / count);

test('what a finger is to hit is large enough, and nothing is beside the screen or over something else', async () => {
  const page = await opened('summary', PHONE);
  for (const view of VIEWS) {
    await show(page, view);
    const found = await page.evaluate(() => {
      const all = [...document.querySelectorAll('button, select, input:not([type=checkbox], [type=radio], [type=range])')].filter((e) => e.checkVisibility()).map((e) => ({ name: e.ariaLabel ?? e.textContent, own: e, box: e.getBoundingClientRect() }));
      const small = all.filter(({ own, box }) => box.width > 0 && (box.height < (own.closest('.bit-grid, .panel-tools, .list') ? 24 : 44) || box.width < 24));
      const tabs = [...document.querySelectorAll('.tabs button')].map((e) => e.getBoundingClientRect());
      return { small: small.map(({ name, box }) => `${name} ${box.width} × ${box.height}`), over: tabs.some((box, at) => at > 0 && box.left < tabs[at - 1].right - 1), wide: document.documentElement.scrollWidth };
    });
    assert.deepEqual(found, { small: [], over: false, wide: 390 }, view);
  }
  await page.done();
});

test('a finger scrolls the trace, and two zoom a graph that one moves', async () => {
  const page = await opened('trace', PHONE);
  const list = page.locator('#view-trace .list');
  await list.evaluate((e) => (e.scrollTop = 0));
  const { x, y, width, height } = await list.boundingBox();
  await fingers(page, line(y + height - 20, y + 20).map((at) => [[x + width / 2, at]]));
  await until(page, 'the rows have moved', () => Number([...document.querySelectorAll('#view-trace .list-row:not([hidden])')].map((r) => r.dataset.index).sort((a, b) => a - b)[0]) > 2);
  await show(page, 'graphs');
  await page.locator('#view-graphs .tree-signal').first().click();
  const canvas = page.locator('.panel-canvas canvas').first();
  await canvas.waitFor();
  const range = () => page.locator('#view-graphs').evaluate((e) => [Number(e.dataset.from), Number(e.dataset.to)]);
  const box = await canvas.boundingBox();
  const middle = box.y + box.height / 2;
  const whole = await range();
  await fingers(page, line(20, 100).map((far) => [[box.x + box.width / 2 - far, middle], [box.x + box.width / 2 + far, middle]]));
  await until(page, 'two fingers zoom', ([from, to]) => ((e) => e.dataset.to - e.dataset.from < (to - from) / 2)(document.querySelector('#view-graphs')), whole);
  const zoomed = await range();
  await fingers(page, line(box.x + box.width - 60, box.x + 120).map((at) => [[at, middle]]));
  await until(page, 'one finger moves it', ([from]) => Number(document.querySelector('#view-graphs').dataset.from) > from, zoomed);
  const moved = await range();
  assert.ok(Math.abs(moved[1] - moved[0] - (zoomed[1] - zoomed[0])) < (zoomed[1] - zoomed[0]) / 100, 'it is moved, and not zoomed');
  await page.done();
});
