//! Finds broken links in the pages: to a file or a heading that does not exist. Checks files that are only named, too: code that
//! looks like a path from the root, such as `wire/src/lib.rs`. Addresses on the network are not looked up.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use pulldown_cmark::{Event, Options, Parser, Tag, TagEnd};

use crate::workspace;

/// Suffixes by which code is recognised as a file's path.
const FILES: [&str; 7] = [".rs", ".md", ".toml", ".sh", ".svg", ".rules", ".yml"];

/// Checks every page of the repository.
pub fn check() -> Result<()> {
    let root = workspace::root();
    let mut pages = BTreeMap::new();
    for path in pages_under(&root)? {
        let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        pages.insert(path, Page::parse(&text));
    }
    ensure!(!pages.is_empty(), "no page in {}", root.display());
    let faults: Vec<String> =
        pages.iter().flat_map(|(path, page)| page.faults(&root, path, &pages)).collect();
    ensure!(faults.is_empty(), "broken links:\n{}", faults.join("\n"));
    println!("{} pages: no broken links", pages.len());
    Ok(())
}

/// What a page links to, and what can be linked to in it.
#[derive(Debug, Default)]
struct Page {
    /// Line and target.
    links: Vec<(usize, String)>,
    /// Line and code.
    named: Vec<(usize, String)>,
    /// Headings, in the form that links use.
    anchors: Vec<String>,
}

impl Page {
    fn parse(text: &str) -> Self {
        let mut page = Self::default();
        let mut heading: Option<String> = None;
        for (event, range) in Parser::new_ext(text, Options::ENABLE_TABLES).into_offset_iter() {
            let line = text[..range.start].matches('\n').count() + 1;
            match event {
                Event::Start(Tag::Link { dest_url, .. } | Tag::Image { dest_url, .. }) => {
                    page.links.push((line, dest_url.into_string()));
                }
                Event::Start(Tag::Heading { .. }) => heading = Some(String::new()),
                Event::End(TagEnd::Heading(_)) => page.anchors.extend(heading.take().as_deref().map(anchor)),
                Event::Text(words) => heading = heading.map(|heading| heading + &words),
                Event::Code(code) => {
                    heading = heading.map(|heading| heading + &code);
                    page.named.push((line, code.into_string()));
                }
                _ => {}
            }
        }
        page
    }

    fn faults(&self, root: &Path, path: &Path, pages: &BTreeMap<PathBuf, Self>) -> Vec<String> {
        let links = self.links.iter().filter(|(_, target)| self.is_broken(target, path, pages));
        let named = self.named.iter().filter(|(_, code)| is_missing(root, code));
        let here = path.strip_prefix(root).unwrap_or(path).display();
        links.chain(named).map(|(line, target)| format!("    {here}:{line}: {target}")).collect()
    }

    fn is_broken(&self, target: &str, path: &Path, pages: &BTreeMap<PathBuf, Self>) -> bool {
        if target.contains("://") || target.starts_with("mailto:") {
            return false;
        }
        let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
        let has = |page: &Self| anchor.is_empty() || page.anchors.iter().any(|known| known == anchor);
        if file.is_empty() {
            return !has(self);
        }
        let Ok(file) = path.with_file_name("").join(file).canonicalize() else { return true };
        pages.get(&file).is_some_and(|page| !has(page))
    }
}

/// Whether code is the path of a file, from the root, that does not exist.
fn is_missing(root: &Path, code: &str) -> bool {
    let Some((top, _)) = code.split_once('/') else { return false };
    let is_path = !code.contains(|other: char| other.is_whitespace() || "*{}<>…".contains(other));
    let is_file = FILES.iter().any(|ending| code.ends_with(ending));
    // Build results exist only after a build.
    is_path && is_file && top != "target" && root.join(top).is_dir() && !root.join(code).exists()
}

/// A heading as GitHub names it in links: lower-case letters, digits, `-` and `_`, with a `-` for each blank.
fn anchor(heading: &str) -> String {
    let kept = |letter: char| match letter {
        ' ' => Some('-'),
        '-' | '_' => Some(letter),
        letter => letter.is_alphanumeric().then_some(letter),
    };
    heading.to_lowercase().chars().filter_map(kept).collect()
}

/// Every page below a folder, except hidden folders and build results.
fn pages_under(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut pages = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let (name, path) = (entry.file_name(), entry.path().canonicalize()?);
        let is_left_out =
            name.as_encoded_bytes().starts_with(b".") || name == "target" || name == "node_modules";
        if entry.file_type()?.is_dir() && !is_left_out {
            pages.extend(pages_under(&path)?);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            pages.push(path);
        }
    }
    Ok(pages)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_to_missing_files_and_headings_are_found_and_others_are_not() {
        let folder = std::env::temp_dir().join(format!("links-{}", std::process::id()));
        fs::create_dir_all(folder.join("docs")).unwrap();
        let text = "# Way of a `Frame`, in µs\n[a](#way-of-a-frame-in-µs) [b](other.md#two) [c](docs) <https://example.org/x>\n\
            [d](#way) [e](other.md#three)\n[f](nowhere.md) `docs/lib.rs` `docs/there.rs` `lib/x.rs`\n";
        fs::write(folder.join("page.md"), text).unwrap();
        fs::write(folder.join("other.md"), "## Two").unwrap();
        fs::write(folder.join("docs/there.rs"), "").unwrap();
        let root = folder.canonicalize().unwrap();
        let pages: BTreeMap<PathBuf, Page> = pages_under(&root)
            .unwrap()
            .into_iter()
            .map(|path| (path.clone(), Page::parse(&fs::read_to_string(path).unwrap())))
            .collect();
        let faults = pages[&root.join("page.md")].faults(&root, &root.join("page.md"), &pages);
        let found: Vec<&str> = faults.iter().map(|fault| fault.trim()).collect();
        fs::remove_dir_all(&folder).unwrap();
        let expected = [
            "page.md:3: #way",
            "page.md:3: other.md#three",
            "page.md:4: nowhere.md",
            "page.md:4: docs/lib.rs",
        ];
        assert_eq!(found, expected);
    }
}
