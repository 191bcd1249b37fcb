// Firefox by WebDriver BiDi, which Playwright speaks to it under the name of a channel.

import { createRequire } from 'node:module';
import { existsSync } from 'node:fs';

const require = createRequire(import.meta.url);
const PROGRAM = process.env.FIREFOX ?? '/usr/bin/firefox-esr';
/** Playwright always sets the colour scheme, by a command that Firefox ESR does not have yet. */
const UNKNOWN = 'emulation.setMediaFeaturesOverride';

/** Why there is none; undefined if there is one. */
export const missing = existsSync(PROGRAM) ? undefined : `${PROGRAM} is not installed; on Debian run \`apt-get install firefox-esr\``;

let browser;

export async function launchFirefox() {
  if (browser) return browser;
  const { ws: WebSocket } = require('playwright-core/lib/utilsBundle');
  const send = WebSocket.prototype.send;
  WebSocket.prototype.send = function (data, ...rest) {
    const message = typeof data === 'string' && data.includes(UNKNOWN) ? JSON.parse(data) : {};
    if (message.method !== UNKNOWN) return send.call(this, data, ...rest);
    setImmediate(() => this.emit('message', Buffer.from(JSON.stringify({ type: 'success', id: message.id, result: {} })), false));
  };
  browser = await require('playwright-core').firefox.launch({ channel: 'moz-firefox', executablePath: PROGRAM });
  return browser;
}

export async function quitFirefox() {
  await browser?.close();
  browser = undefined;
}
