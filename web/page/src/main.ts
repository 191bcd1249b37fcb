import { loadEngine } from './engine';
import { start } from './start';

void start(loadEngine);
