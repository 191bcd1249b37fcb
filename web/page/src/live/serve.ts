// A page that `cantap ui` or `cantap serve` serves: live from a device, or with a trace.

import type { App } from '../model/app';
import { addCarried } from '../model/report';
import { Connection } from './connection';
import type { Served } from './protocol';

/** What the server put into the page; null if the page comes from elsewhere. */
export function servedFrom(root: Document): Served | null {
  const text = root.getElementById('cantap-live')?.textContent?.trim();
  return text ? (JSON.parse(text) as Served) : null;
}

/** Opens what is served. */
export async function serve(app: App, served: Served): Promise<void> {
  await addCarried(app, served);
  if (served.kind === 'trace') {
    try {
      await app.openTrace(await fetched(served.name), served.bitrates);
    } catch (error) {
      app.failed(error);
    }
    return;
  }
  const rates = new Map<number, number>();
  const live = new Connection(
    async (chunks, anew) => {
      if (anew) rates.clear();
      await app.takeLive(served.name, chunks, anew);
      for (const { channel, bitrate } of live.state?.channels ?? []) {
        if (bitrate === null || rates.get(channel) === bitrate) continue;
        rates.set(channel, bitrate);
        await app.ask('bitrate', { channel, bitrate });
      }
    },
    (level, text) => app.notify(level, text),
    served.command,
  );
  app.live = app.server = live;
  for (const topic of ['status', 'state', 'progress'] as const) live.on(topic, () => app.emit('live-state'));
  await app.begin(served.name);
  live.connect();
}

async function fetched(name: string): Promise<File> {
  const answer = await fetch(`trace${location.search}`, { cache: 'no-store' }).catch(() => null);
  if (!answer?.ok) throw new Error(`${name} did not come from cantap ui: ${answer ? (await answer.text()).trim() : 'it has ended; start it again.'}`);
  return new File([await answer.blob()], name);
}
