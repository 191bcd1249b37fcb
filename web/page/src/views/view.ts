// What every view is: an element, and what happens when it comes into sight.

export interface View {
  id: string;
  title: string;
  element: HTMLElement;
  /** It came into sight. */
  shown(): void;
  hidden?(): void;
}
