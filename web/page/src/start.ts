// Starts the page: with the report that is packed into it, or with a screen that takes files.

import type { Engine } from './api';
import { App } from './model/app';
import { openFiles } from './model/open-files';
import { serve, servedFrom } from './live/serve';
import { addCarried, embeddedReport, type Report, unpack } from './model/report';
import { Shell, applyTheme } from './shell';
import { button, el, replace } from './ui/dom';
import { openBoard } from './views/open-board';
import { Notices } from './ui/notices';

export async function start(loadEngine: () => Promise<Engine>): Promise<void> {
  const root = document.body;
  const notices = new Notices();
  const place = el('div', { id: 'cantap' });
  applyTheme('auto');
  root.append(place);
  replace(place, el('p', { class: 'starting', attrs: { role: 'status' } }, 'Starting …'));
  let engine: Engine;
  try {
    engine = await loadEngine();
  } catch (error) {
    replace(place, failure('The page cannot start', error));
    return;
  }
  const app = new App(engine, loadEngine, notices.notify);
  applyTheme(app.profile.theme);
  let report: Report | null = null;
  try {
    report = embeddedReport(document);
  } catch (error) {
    app.failed(error);
  }
  const served = servedFrom(document);
  const screen = startScreen(app);
  let shown = false;
  const showShell = (): void => {
    if (shown || !app.summary) return;
    shown = true;
    place.replaceChildren(new Shell(app, notices.element).element);
  };
  app.on('summary', showShell);
  replace(place, report ? el('p', { class: 'starting', attrs: { role: 'status' } }, `Opening ${report.trace.name} …`) : screen, notices.element);
  if (served) {
    replace(place, el('p', { class: 'starting', attrs: { role: 'status' } }, `Waiting for ${served.name} …`), notices.element);
    await serve(app, served);
    return;
  }
  if (app.storage.refused !== null) notices.notify('info', 'This browser keeps nothing for this page: save your layout as a profile (Ctrl+K) if you want it again.');
  if (report) {
    app.report = report;
    // Whoever opens a report sees its findings first, whatever was looked at last.
    app.profile.view = 'summary';
    if (!(await openReport(app, report)) && !shown) replace(place, screen, notices.element);
  }
}

async function openReport(app: App, report: Report): Promise<boolean> {
  try {
    await addCarried(app, report);
    await app.openTrace(await unpack(report.trace), report.bitrates);
    return true;
  } catch (error) {
    app.failed(error);
    return false;
  }
}

function startScreen(app: App): HTMLElement {
  const picker = el('input', { attrs: { type: 'file', multiple: true, hidden: true, 'aria-label': 'Trace and databases' } });
  picker.addEventListener('change', () => void openFiles(app, [...(picker.files ?? [])]));
  const screen = el(
    'main',
    { class: 'start', attrs: { 'aria-label': 'Start' } },
    el('h1', {}, 'cantap'),
    el('p', {}, 'Drop a CAN trace here, and databases for its signals.'),
    button('Choose files …', () => picker.click(), { class: 'primary' }),
    picker,
    el('p', {}, 'Or see a bus live, with a cantap board on this computer’s USB.'),
    button('Open board …', () => void openBoard(app)),
    el('p', { class: 'muted' }, 'Traces: candump, ASC, BLF, TRC, MF4, pcapng, CSV and more. Databases: DBC, KCD, SYM, ARXML, DBF.'),
    el('p', { class: 'muted' }, 'Everything stays on this machine: the page sends nothing anywhere.'),
  );
  screen.addEventListener('dragover', (event) => {
    event.preventDefault();
    screen.classList.add('drop');
  });
  screen.addEventListener('dragleave', () => screen.classList.remove('drop'));
  screen.addEventListener('drop', (event) => {
    event.preventDefault();
    screen.classList.remove('drop');
    void openFiles(app, [...(event.dataTransfer?.files ?? [])]);
  });
  return screen;
}

function failure(title: string, error: unknown): HTMLElement {
  return el('main', { class: 'start' }, el('h1', {}, title), el('p', { class: 'bad', attrs: { role: 'alert' } }, error instanceof Error ? error.message : String(error)), el('p', {}, 'A current Chromium, Firefox or Safari opens it. The command “cantap” reads the same traces in a terminal.'));
}
