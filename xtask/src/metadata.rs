//! What cargo knows about the workspace and everything in its lock file.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, Result};
use serde::Deserialize;
use xshell::{Shell, cmd};

/// The part of `cargo metadata` that is used here.
#[derive(Deserialize)]
pub struct Metadata {
    /// Our own packages and everybody else's.
    pub packages: Vec<Package>,
    workspace_members: Vec<String>,
}

/// A package.
#[derive(Deserialize)]
pub struct Package {
    id: String,
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: String,
    /// Its licence, as an SPDX expression.
    pub license: Option<String>,
    /// Its features, and what each turns on.
    pub features: BTreeMap<String, Vec<String>>,
    /// Where its source is.
    pub manifest_path: PathBuf,
    #[cfg(feature = "check")]
    #[serde(default)]
    targets: Vec<Target>,
    /// Empty if it must not be published.
    publish: Option<Vec<String>>,
    /// Where it comes from; nothing for our own.
    pub source: Option<String>,
    /// Its page.
    pub repository: Option<String>,
}

/// What a package compiles to.
#[cfg(feature = "check")]
#[derive(Deserialize)]
struct Target {
    kind: Vec<String>,
    name: String,
}

impl Metadata {
    /// Asks cargo for all targets with all features.
    pub fn read(shell: &Shell) -> Result<Self> {
        let text = cmd!(shell, "cargo metadata --locked --format-version 1 --all-features").quiet().read()?;
        serde_json::from_str(&text).context("cargo metadata")
    }

    /// The packages of this repository.
    pub fn members(&self) -> impl Iterator<Item = &Package> {
        self.packages.iter().filter(|package| self.workspace_members.contains(&package.id))
    }

    /// Other people's packages.
    pub fn others(&self) -> impl Iterator<Item = &Package> {
        self.packages.iter().filter(|package| !self.workspace_members.contains(&package.id))
    }
}

impl Package {
    /// The name of its library, if it has one.
    #[cfg(feature = "check")]
    pub fn library(&self) -> Option<&str> {
        let target = self.targets.iter().find(|target| target.kind.iter().any(|kind| kind == "lib"))?;
        Some(&target.name)
    }

    /// Whether it can be published.
    pub fn is_published(&self) -> bool {
        self.publish.as_ref().is_none_or(|registries| !registries.is_empty())
    }
}
