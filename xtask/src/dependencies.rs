//! Other people's crates, checked against `deny.toml`: only licences allowed in what we publish, no crate in two versions without a
//! reason, no source other than the registry.
//!
//! cargo-deny, which reads the same file, does this in hosted CI and checks advisories as well. It is not built here because it has some
//! 300 dependencies itself.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Context, Result, ensure};
use serde::Deserialize;
use spdx::{Expression, LicenseReq, ParseMode};
use xshell::Shell;

use crate::metadata::{Metadata, Package};

/// The part of `deny.toml` that is checked here.
#[derive(Deserialize)]
struct Rules {
    licenses: Licences,
    bans: Bans,
}

#[derive(Deserialize)]
struct Licences {
    allow: Vec<String>,
}

#[derive(Deserialize)]
struct Bans {
    skip: Vec<Skip>,
}

/// A version of a crate that is allowed alongside another.
#[derive(Deserialize)]
struct Skip {
    #[serde(rename = "crate")]
    name_and_version: String,
}

/// Checks all crates and names every fault.
pub fn check(shell: &Shell) -> Result<()> {
    let rules: Rules = toml::from_str(&shell.read_file("deny.toml")?).context("deny.toml")?;
    let metadata = Metadata::read(shell)?;
    let others: Vec<&Package> = metadata.others().collect();
    let faults: Vec<String> = licences(&others, &rules.licenses.allow)
        .chain(duplicates(&others, &rules.bans.skip))
        .chain(sources(&others))
        .collect();
    ensure!(faults.is_empty(), "against deny.toml:\n{}", faults.join("\n"));
    println!("{} crates of other people: licences, versions and sources are allowed", others.len());
    Ok(())
}

fn licences<'a>(others: &'a [&Package], allowed: &'a [String]) -> impl Iterator<Item = String> + 'a {
    others.iter().filter_map(move |package| {
        let Package { name, version, .. } = package;
        let Some(text) = &package.license else { return Some(format!("{name} {version} names no licence")) };
        // Older crates write `/` for OR.
        match Expression::parse_mode(text, ParseMode::LAX) {
            Err(error) => Some(format!("{name} {version} has a licence that is not valid SPDX: {error}")),
            Ok(expression) if expression.evaluate(|licence| is_allowed(licence, allowed)) => None,
            Ok(_) => Some(format!("{name} {version} is under {text}, which is not allowed")),
        }
    })
}

/// "Or a later version" leaves the choice of the version that is allowed.
fn is_allowed(licence: &LicenseReq, allowed: &[String]) -> bool {
    let text = licence.to_string();
    allowed.iter().any(|allowed| allowed == text.strip_suffix('+').unwrap_or(&text))
}

/// Crates present in several versions of which more than one is not excused, and excuses that are no longer needed.
fn duplicates(others: &[&Package], skip: &[Skip]) -> impl Iterator<Item = String> {
    let excused: BTreeSet<&str> = skip.iter().map(|skip| skip.name_and_version.as_str()).collect();
    let mut versions: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for package in others {
        versions.entry(&package.name).or_default().push(format!("{}@{}", package.name, package.version));
    }
    let mut faults = Vec::new();
    let mut needed = BTreeSet::new();
    for (name, versions) in versions.iter().filter(|(_, versions)| versions.len() > 1) {
        let open = versions.iter().filter(|version| !excused.contains(version.as_str())).count();
        if open > 1 {
            faults.push(format!("{name} is present in {} versions: {}", versions.len(), versions.join(", ")));
        }
        needed.extend(versions.iter().cloned());
    }
    faults.extend(
        excused
            .iter()
            .filter(|excuse| !needed.contains(**excuse))
            .map(|excuse| format!("{excuse} no longer needs an excuse")),
    );
    faults.into_iter()
}

fn sources<'a>(others: &'a [&Package]) -> impl Iterator<Item = String> + 'a {
    others.iter().filter_map(|package| {
        let from_registry = package.source.as_deref().is_some_and(|source| source.starts_with("registry+"));
        (!from_registry)
            .then(|| format!("{} {} does not come from the registry", package.name, package.version))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn package(name: &str, version: &str, license: &str) -> Package {
        let text = format!(
            r#"{{"id": "{name}", "name": "{name}", "version": "{version}", "license": "{license}", "features": {{}},
            "manifest_path": "", "publish": null, "source": "registry+a", "repository": null}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    fn faults_of(license: &str) -> Vec<String> {
        let package = package("a", "1.0.0", license);
        licences(&[&package], &["MIT", "MPL-2.0", "Apache-2.0 WITH LLVM-exception"].map(str::to_owned))
            .collect()
    }

    #[test]
    fn a_licence_is_allowed_where_each_part_that_must_hold_is() {
        for good in
            ["MIT", "MPL-2.0+", "GPL-3.0-only OR MIT", "MIT/Apache-2.0", "Apache-2.0 WITH LLVM-exception"]
        {
            assert_eq!(faults_of(good), Vec::<String>::new(), "{good}");
        }
        for bad in ["GPL-3.0-only", "MIT AND BSD-3-Clause", "Apache-2.0", "as you like"] {
            assert_eq!(faults_of(bad).len(), 1, "{bad}");
        }
    }

    #[test]
    fn a_second_version_needs_an_excuse_and_an_excuse_needs_a_second_version() {
        let (old, new) = (package("a", "1.0.0", "MIT"), package("a", "2.0.0", "MIT"));
        let excuse = |text: &str| Skip { name_and_version: text.to_owned() };
        assert_eq!(duplicates(&[&old, &new], &[]).count(), 1);
        assert_eq!(duplicates(&[&old, &new], &[excuse("a@1.0.0")]).count(), 0);
        assert_eq!(duplicates(&[&new], &[excuse("a@1.0.0")]).count(), 1);
    }
}
