//! Finds files of one crate that import each other in a circle, and public types of a library that share a name.
//!
//! Parses the sources to find which file names a path into which other. A `pub use` alone is a front door, not an import; a path
//! through one, or through what another module imports, or through all names of a module (`*`), leads to where the item is defined. Imports by tests alone do not count, and neither do methods, which name no file.
//! Inside a macro's arguments, which have no grammar, only paths from `crate`, `self` or `super` are seen.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use proc_macro2::{TokenStream, TokenTree};
use syn::ext::IdentExt;
use syn::visit::{self, Visit};
use syn::{Attribute, Item, ItemMod, ItemUse, UseTree, Visibility};

use crate::workspace;

/// A module's path from its crate's root.
type Module = Vec<String>;

/// Checks every crate of the workspace.
pub fn check() -> Result<()> {
    let mut faults = Vec::new();
    for manifest in manifests(&workspace::root())? {
        for root in ["src/lib.rs", "src/main.rs"] {
            let root = manifest.join(root);
            if root.exists() {
                let krate = Crate::read(&root)?;
                faults.extend(krate.circles());
                if root.ends_with("lib.rs") {
                    faults.extend(krate.namesakes());
                }
            }
        }
    }
    ensure!(faults.is_empty(), "{}", faults.join("\n"));
    Ok(())
}

/// The folders of the workspace's crates.
fn manifests(root: &Path) -> Result<Vec<PathBuf>> {
    let text = fs::read_to_string(root.join("Cargo.toml"))?;
    let manifest: toml::Table = toml::from_str(&text)?;
    let members = manifest["workspace"]["members"].as_array().context("no members in the workspace")?;
    let members = members.iter().filter_map(|member| member.as_str()).map(|member| root.join(member));
    Ok(std::iter::once(root.to_owned()).chain(members).collect())
}

/// What is known about one crate.
#[derive(Default)]
struct Crate {
    /// Its modules, with the file that each is in.
    files: BTreeMap<Module, PathBuf>,
    /// The paths that each module names.
    named: Vec<(Module, Paths)>,
    /// Names that a module imports or re-exports, and where they come from.
    doors: BTreeMap<(Module, String), Module>,
    /// Modules of which a module imports or re-exports all names.
    wide_doors: BTreeMap<Module, Vec<Module>>,
    /// Names that a module defines.
    defined: BTreeSet<(Module, String)>,
    /// Public types by name: the files that define one.
    types: BTreeMap<String, Vec<PathBuf>>,
}

/// The paths that a module names, as written there.
#[derive(Default)]
struct Paths(BTreeSet<Vec<String>>);

/// Where a name leads that a module has from elsewhere.
enum Way<'a> {
    To(&'a PathBuf),
    OutOfTheCrate,
}

impl<'a> From<Option<&'a PathBuf>> for Way<'a> {
    fn from(file: Option<&'a PathBuf>) -> Self {
        file.map_or(Self::OutOfTheCrate, Self::To)
    }
}

impl Crate {
    fn read(root: &Path) -> Result<Self> {
        let mut krate = Self::default();
        krate.read_file(root, &root.with_file_name(""), Vec::new())?;
        Ok(krate)
    }

    /// Reads a file and the modules that it declares; modules with a file of their own are below `folder`.
    fn read_file(&mut self, file: &Path, folder: &Path, module: Module) -> Result<()> {
        let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
        let parsed = syn::parse_file(&text).with_context(|| file.display().to_string())?;
        self.read_items(&parsed.items, file, folder, module)
    }

    fn read_items(&mut self, items: &[Item], file: &Path, folder: &Path, module: Module) -> Result<()> {
        self.files.insert(module.clone(), file.to_owned());
        let mut named = Paths::default();
        for item in items.iter().filter(|item| !is_left_out(attributes(item))) {
            match item {
                Item::Mod(declared) => self.read_module(declared, file, folder, &module)?,
                Item::Use(used) => self.read_use(used, &module, &mut named),
                other => {
                    self.note_type(other, file);
                    self.defined.extend(name(other).map(|name| (module.clone(), name)));
                    named.visit_item(other);
                }
            }
        }
        self.named.push((module, named));
        Ok(())
    }

    fn read_module(&mut self, declared: &ItemMod, file: &Path, folder: &Path, parent: &Module) -> Result<()> {
        let name = declared.ident.unraw().to_string();
        let module = [parent.clone(), vec![name.clone()]].concat();
        let below = folder.join(&name);
        if let Some((_, items)) = &declared.content {
            return self.read_items(items, file, &below, module);
        }
        let beside = folder.join(format!("{name}.rs"));
        let file = if beside.exists() { beside } else { below.join("mod.rs") };
        self.read_file(&file, &below, module)
    }

    fn read_use(&mut self, used: &ItemUse, module: &Module, named: &mut Paths) {
        let public = !matches!(used.vis, Visibility::Inherited);
        for (path, name) in leaves(&used.tree) {
            if name == "*" {
                self.wide_doors.entry(module.clone()).or_default().push(path.clone());
            } else {
                self.doors.insert((module.clone(), name), path.clone());
            }
            if !public {
                named.0.insert(path);
            }
        }
    }

    fn note_type(&mut self, item: &Item, file: &Path) {
        let (visibility, name) = match item {
            Item::Struct(item) => (&item.vis, &item.ident),
            Item::Enum(item) => (&item.vis, &item.ident),
            Item::Trait(item) => (&item.vis, &item.ident),
            Item::Type(item) => (&item.vis, &item.ident),
            _ => return,
        };
        if matches!(visibility, Visibility::Public(_)) {
            self.types.entry(name.to_string()).or_default().push(file.to_owned());
        }
    }

    /// The file that defines what a path names, if it is in this crate.
    fn file_of(&self, from: &Module, path: &[String], depth: usize) -> Option<&PathBuf> {
        let mut at = from.clone();
        let mut rest = path;
        match rest.first()?.as_str() {
            "crate" => {
                at.clear();
                rest = &rest[1..];
            }
            "self" => rest = &rest[1..],
            "super" => {}
            first => {
                let child = [from.clone(), vec![first.to_owned()]].concat();
                let is_ours = self.files.contains_key(&child)
                    || self.doors.contains_key(&(from.clone(), first.to_owned()));
                return is_ours.then(|| self.descend(at, rest, depth))?;
            }
        }
        while rest.first().is_some_and(|segment| segment == "super") {
            at.pop()?;
            rest = &rest[1..];
        }
        self.descend(at, rest, depth)
    }

    fn descend(&self, mut at: Module, path: &[String], depth: usize) -> Option<&PathBuf> {
        for (n, segment) in path.iter().enumerate() {
            let child = [at.clone(), vec![segment.clone()]].concat();
            if self.files.contains_key(&child) {
                at = child;
                continue;
            }
            if depth < 8
                && let Some(file) = self.through_a_door(&at, segment, &path[n + 1..], depth)
            {
                return match file {
                    Way::To(file) => Some(file),
                    Way::OutOfTheCrate => None,
                };
            }
            break;
        }
        self.files.get(&at)
    }

    /// Where a name leads that this module has from elsewhere: to a file of this crate, or out of it. `None` if it has it from nowhere.
    fn through_a_door(&self, at: &Module, name: &str, rest: &[String], depth: usize) -> Option<Way<'_>> {
        let item = (at.clone(), name.to_owned());
        if self.defined.contains(&item) {
            return None;
        }
        if let Some(door) = self.doors.get(&item) {
            return Some(self.file_of(at, &[door, rest].concat(), depth + 1).into());
        }
        let modules = self.wide_doors.get(at)?.iter().filter_map(|door| self.module_of(at, door));
        modules
            .filter(|module| *module != *at)
            .find(|module| {
                let item = (module.clone(), name.to_owned());
                self.defined.contains(&item)
                    || self.doors.contains_key(&item)
                    || self.files.contains_key(&[module.clone(), vec![name.to_owned()]].concat())
            })
            .map(|module| self.descend(module, &[&[name.to_owned()], rest].concat(), depth + 1).into())
    }

    /// The module of this crate that a path names.
    fn module_of(&self, from: &Module, path: &[String]) -> Option<Module> {
        let mut module = match path.first()?.as_str() {
            "crate" => Vec::new(),
            _ => from.clone(),
        };
        for segment in path {
            match segment.as_str() {
                "crate" | "self" => {}
                "super" => drop(module.pop()?),
                name => module.push(name.to_owned()),
            }
        }
        self.files.contains_key(&module).then_some(module)
    }

    /// Which file imports which.
    fn imports(&self) -> BTreeMap<&PathBuf, BTreeSet<&PathBuf>> {
        let mut imports: BTreeMap<&PathBuf, BTreeSet<&PathBuf>> = BTreeMap::new();
        for (module, named) in &self.named {
            let Some(file) = self.files.get(module) else { continue };
            let targets = named.0.iter().filter_map(|path| self.file_of(module, path, 0));
            imports.entry(file).or_default().extend(targets.filter(|target| *target != file));
        }
        imports
    }

    /// A line for each group of files that import each other.
    fn circles(&self) -> Vec<String> {
        let imports = self.imports();
        let reachable: BTreeMap<&PathBuf, BTreeSet<&PathBuf>> =
            imports.keys().map(|file| (*file, reach(&imports, file))).collect();
        let mut groups: BTreeSet<BTreeSet<&PathBuf>> = BTreeSet::new();
        for (file, reached) in &reachable {
            if reached.contains(file) {
                let group =
                    reached.iter().filter(|other| reachable[*other].contains(file)).copied().collect();
                groups.insert(group);
            }
        }
        let describe = |group: BTreeSet<&PathBuf>| {
            let within = |file: &&PathBuf| imports[file].intersection(&group).map(short).collect::<Vec<_>>();
            let each: Vec<String> = group
                .iter()
                .map(|file| format!("\n    {} imports {}", short(file), within(file).join(", ")))
                .collect();
            format!("files that import each other in a circle:{}", each.concat())
        };
        groups.into_iter().map(describe).collect()
    }

    /// A line for each name shared by several public types.
    fn namesakes(&self) -> Vec<String> {
        let twice = self.types.iter().filter(|(_, files)| files.len() > 1);
        let describe = |(name, files): (&String, &Vec<PathBuf>)| {
            let files: Vec<String> = files.iter().map(short).collect();
            format!("more than one public type is called {name}: {}", files.join(", "))
        };
        twice.map(describe).collect()
    }
}

/// All files that `from` imports, directly or indirectly.
fn reach<'a>(
    imports: &BTreeMap<&'a PathBuf, BTreeSet<&'a PathBuf>>,
    from: &PathBuf,
) -> BTreeSet<&'a PathBuf> {
    let mut reached = BTreeSet::new();
    let mut next: Vec<&PathBuf> = imports.get(from).into_iter().flatten().copied().collect();
    while let Some(file) = next.pop() {
        if reached.insert(file) {
            next.extend(imports.get(file).into_iter().flatten().copied());
        }
    }
    reached
}

fn short(path: impl AsRef<Path>) -> String {
    let path = path.as_ref();
    path.strip_prefix(workspace::root()).unwrap_or(path).display().to_string()
}

/// The attributes of an item that can hold code.
fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(item) => &item.attrs,
        Item::Enum(item) => &item.attrs,
        Item::Fn(item) => &item.attrs,
        Item::Impl(item) => &item.attrs,
        Item::Macro(item) => &item.attrs,
        Item::Mod(item) => &item.attrs,
        Item::Static(item) => &item.attrs,
        Item::Struct(item) => &item.attrs,
        Item::Trait(item) => &item.attrs,
        Item::Type(item) => &item.attrs,
        Item::Use(item) => &item.attrs,
        _ => &[],
    }
}

/// The name that an item defines.
fn name(item: &Item) -> Option<String> {
    let name = match item {
        Item::Const(item) => &item.ident,
        Item::Enum(item) => &item.ident,
        Item::Fn(item) => &item.sig.ident,
        Item::Static(item) => &item.ident,
        Item::Struct(item) => &item.ident,
        Item::Trait(item) => &item.ident,
        Item::Type(item) => &item.ident,
        Item::Union(item) => &item.ident,
        _ => return None,
    };
    Some(name.unraw().to_string())
}

/// Test-only items, and files that `#[path]` takes from elsewhere, which belong to another crate.
fn is_left_out(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| match &attribute.meta {
        syn::Meta::List(list) => list.path.is_ident("cfg") && list.tokens.to_string() == "test",
        meta => meta.path().is_ident("path"),
    })
}

/// The paths of a `use`, each with the name it introduces: `*` for all names of a module.
fn leaves(tree: &UseTree) -> Vec<(Vec<String>, String)> {
    match tree {
        UseTree::Path(path) => {
            let first = path.ident.to_string();
            let with_first = |(rest, name): (Vec<String>, String)| {
                let name = if name == "self" { first.clone() } else { name };
                ([vec![first.clone()], rest].concat(), name)
            };
            leaves(&path.tree).into_iter().map(with_first).collect()
        }
        UseTree::Name(name) if name.ident == "self" => vec![(Vec::new(), "self".to_owned())],
        UseTree::Name(name) => vec![(vec![name.ident.to_string()], name.ident.to_string())],
        UseTree::Rename(rename) if rename.ident == "self" => vec![(Vec::new(), rename.rename.to_string())],
        UseTree::Rename(rename) => vec![(vec![rename.ident.to_string()], rename.rename.to_string())],
        UseTree::Glob(_) => vec![(Vec::new(), "*".to_owned())],
        UseTree::Group(group) => group.items.iter().flat_map(leaves).collect(),
    }
}

impl Visit<'_> for Paths {
    /// `pub(super)` imports nothing.
    fn visit_visibility(&mut self, _: &Visibility) {}

    fn visit_path(&mut self, path: &syn::Path) {
        if path.leading_colon.is_none() {
            self.0.insert(path.segments.iter().map(|segment| segment.ident.to_string()).collect());
        }
        visit::visit_path(self, path);
    }

    fn visit_item_use(&mut self, used: &ItemUse) {
        self.0.extend(leaves(&used.tree).into_iter().map(|(path, _)| path));
    }

    fn visit_macro(&mut self, call: &syn::Macro) {
        self.visit_path(&call.path);
        self.visit_tokens(call.tokens.clone());
    }
}

impl Paths {
    /// Finds `crate::…`, `self::…` and `super::…` in unparsed tokens.
    fn visit_tokens(&mut self, tokens: TokenStream) {
        let mut path: Vec<String> = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Ident(segment) => {
                    if colons != 2 {
                        self.keep(std::mem::take(&mut path));
                    }
                    path.push(segment.to_string());
                    colons = 0;
                }
                TokenTree::Punct(colon) if colon.as_char() == ':' => colons += 1,
                other => {
                    self.keep(std::mem::take(&mut path));
                    colons = 0;
                    if let TokenTree::Group(group) = other {
                        self.visit_tokens(group.stream());
                    }
                }
            }
        }
        self.keep(path);
    }

    fn keep(&mut self, path: Vec<String>) {
        if path.len() > 1 && matches!(path[0].as_str(), "crate" | "self" | "super") {
            self.0.insert(path);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    /// The faults found in a crate made of these files.
    fn faults(files: &[(&str, &str)]) -> Vec<String> {
        static FOLDERS: AtomicU32 = AtomicU32::new(0);
        let number = FOLDERS.fetch_add(1, Ordering::Relaxed);
        let folder = std::env::temp_dir().join(format!("circles-{}-{number}", std::process::id()));
        for (name, text) in files {
            let file = folder.join(name);
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            fs::write(file, text).unwrap();
        }
        let krate = Crate::read(&folder.join("lib.rs")).unwrap();
        fs::remove_dir_all(&folder).unwrap();
        krate.circles().into_iter().chain(krate.namesakes()).collect()
    }

    #[test]
    fn a_circle_is_found_through_all_names_of_a_module_and_through_what_another_imports() {
        for (door, a) in [
            (
                "mod c; pub struct Two(crate::One); pub use c::*;",
                "pub struct One; fn f() -> crate::b::Three { todo!() }",
            ),
            (
                "mod c; use c::Three; pub struct Two(crate::One, Three);",
                "pub struct One; fn f() { use crate::b::Three; }",
            ),
        ] {
            let files = [
                ("lib.rs", "pub mod a; pub mod b; pub use a::*;"),
                ("a.rs", a),
                ("b/mod.rs", door),
                ("b/c.rs", "use crate::One; pub struct Three(One);"),
            ];
            let found = faults(&files);
            assert_eq!(found.len(), 1, "{found:?}");
            assert!(found[0].contains("a.rs imports"), "{found:?}");
            assert!(found[0].contains("c.rs imports"), "{found:?}");
        }
    }

    #[test]
    fn a_circle_is_found_through_a_front_door_and_a_child_and_none_where_there_is_none() {
        let straight = [
            ("lib.rs", "pub mod a; pub mod b; pub use a::One;"),
            ("a.rs", "pub struct One; #[cfg(test)] mod tests { use crate::b::Two; }"),
            ("b/mod.rs", "mod c; pub struct Two(crate::One); pub use c::Three;"),
            ("b/c.rs", "use super::Two; pub struct Three(Two);"),
        ];
        assert_eq!(faults(&straight), [""; 0]);
        let mut round = straight.to_vec();
        for a in [
            "pub struct One; fn f() -> crate::b::Three { todo!() }",
            "pub struct One; fn f() { use super::b::Three; }",
            "pub struct One; fn f() { println!(\"{}\", [1].map(|_| super::b::Three)); }",
        ] {
            round[1].1 = a;
            let found = faults(&round);
            assert_eq!(found.len(), 1, "{found:?}");
            assert!(
                found[0].contains("a.rs imports") && found[0].matches("imports").count() == 3,
                "{found:?}"
            );
        }
        let twins =
            [("lib.rs", "mod a; mod b; mod c;"), ("a.rs", "pub enum One {}"), ("b.rs", "pub trait One {}")];
        let twins = [&twins[..], &[("c.rs", "struct One;")]].concat();
        assert_eq!(faults(&twins).len(), 1);
    }
}
