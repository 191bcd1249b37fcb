// How numbers are written, without a browser.

import assert from 'node:assert/strict';
import { join } from 'node:path';
import { test } from 'node:test';
import { build } from 'esbuild';
import { HERE } from './browser.mjs';

/** A module of the page. */
async function module(name) {
  const { outputFiles } = await build({ entryPoints: [join(HERE, '../src', name)], bundle: true, write: false, format: 'esm', logLevel: 'warning' });
  return import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].text).toString('base64')}`);
}

const { percent, quantity, shortCount } = await module('model/format.ts');
const { tickTexts, ticks } = await module('graph/scale.ts');

test('a value has all its digits, and none of the arithmetic’s', () => {
  for (const [value, text] of [
    [16777217, '16777217'],
    [4294967295, '4294967295'],
    [1234567.8, '1234567.8'],
    [0.1 + 0.2, '0.3'],
    [-40, '−40'],
    [0, '0'],
  ])
    assert.equal(quantity(value, ''), text);
  assert.equal(quantity(16777217, 'km'), '16777217 km');
});

test('what is there, but little, is not written as nothing', () => {
  assert.deepEqual([0, 0.0001, 0.0005, 0.25, 1, null].map(percent), ['0.0 %', '< 0.1 %', '0.1 %', '25.0 %', '100.0 %', '–']);
});

test('a count in little room is never more than it is', () => {
  assert.deepEqual([0, 999, 1000, 1999, 12_345, 999_999, 1_239_999, 4_294_967_295].map(shortCount), ['0', '999', '1.00k', '1.99k', '12.3k', '999k', '1.23M', '4294M']);
});

test('no two ticks of an axis have the same text', () => {
  for (const [from, to] of [[0, 1], [10_000_000, 10_000_500], [1e9, 1e9 + 3], [7.1776e16, 7.1776e16 + 1500], [-5e12, -5e12 + 40], [1e-7, 5e-7]]) {
    const texts = tickTexts(ticks(from, to, 5));
    assert.equal(new Set(texts).size, texts.length, texts.join(', '));
  }
  assert.deepEqual(tickTexts(ticks(10_000_000, 10_000_200, 4)), ['10000000', '10000050', '10000100', '10000150', '10000200']);
});
