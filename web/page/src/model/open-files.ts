// Files that were dropped or picked: databases are added, a trace replaces the one that is open.

import { mayReplace } from '../views/open-board';
import type { App } from './app';
import { isDatabase } from './files';

export async function openFiles(app: App, files: File[]): Promise<void> {
  const traces = files.filter((f) => !isDatabase(f.name));
  if (traces.length > 1) app.notify('warning', `Only ${traces[0]?.name} was opened: one trace at a time. Join traces with “cantap convert” first.`);
  for (const file of files.filter((f) => isDatabase(f.name))) {
    try {
      await app.addDatabase(file.name, new Uint8Array(await file.arrayBuffer()), null);
    } catch (error) {
      app.failed(error instanceof Error ? new Error(`${file.name}: ${error.message}`) : error);
    }
  }
  const trace = traces[0];
  if (!trace || !(await mayReplace(app))) return;
  app.live = app.server;
  try {
    await app.openTrace(trace);
  } catch (error) {
    app.failed(error);
  }
}
