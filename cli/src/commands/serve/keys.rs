//! `cantap serve keygen`, and the files for `--tls`: the server's identity, and whom it trusts.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use cantap_address::server::role;
use cantap_serve::Role;
use cantap_serve::tls::{Files, Keys, LIFETIME_DAYS, Server};
use cantap_trace::clean;

use crate::usage_error::usage;

/// What else the command can do.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Make keys: an authority, the server's, and clients' with their roles.
    Keygen {
        /// Folder for the files; an existing authority in it makes further clients.
        folder: PathBuf,
        /// A name or address by which clients reach the server. Can be repeated.
        #[arg(long = "host", value_name = "HOST")]
        hosts: Vec<String>,
        /// A client and its maximum role: alice:listen, bob:send. Can be repeated.
        #[arg(long = "client", value_name = "NAME:ROLE", value_parser = named_role)]
        clients: Vec<(String, Role)>,
        /// Make a new key and certificate for a client, with the same role. Can be repeated.
        #[arg(long, value_name = "NAME")]
        renew: Vec<String>,
        /// Put a client's certificate on the list of those that are let in no more (revoked.pem, for --revoked). Can be repeated.
        #[arg(long, value_name = "NAME")]
        revoke: Vec<String>,
        /// How long the certificates made now are valid, in days.
        #[arg(long, value_name = "DAYS", default_value_t = LIFETIME_DAYS, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
    },
}

/// Parses two file names.
pub fn two_files(text: &str) -> Result<(PathBuf, PathBuf), String> {
    let files = text.split_once(',');
    let files =
        files.ok_or("give two files, the certificate's and the key's, as server.pem,server-key.pem")?;
    Ok((files.0.into(), files.1.into()))
}

fn named_role(text: &str) -> Result<(String, Role), String> {
    let (name, may) = text.split_once(':').ok_or("write it as NAME:ROLE, as alice:listen")?;
    Ok((name.to_owned(), role(may)?))
}

impl Command {
    /// Makes keys and lists them.
    pub fn run(&self) -> anyhow::Result<ExitCode> {
        let Self::Keygen { folder, hosts, clients, renew, revoke, days } = self;
        let has_server = Keys::files(folder, "server").certificate.exists();
        if !has_server && hosts.is_empty() {
            return Err(usage(
                "name the server's computer with --host, as clients will; repeat it for each name and address",
            ));
        }
        let keys = Keys::in_folder(folder)?.lasting(*days);
        // In this order, `--revoke NAME --renew NAME` locks the old certificate out and not the new one.
        for name in revoke {
            let list = keys.revoke_client(name)?;
            writeln!(io::stdout(), "{}", list.display())?;
            eprintln!(
                "cantap: '{}' is revoked: give the list to the server with --revoked, and send it SIGHUP",
                clean::line(name)
            );
        }
        let mut made = Vec::new();
        for name in renew {
            made.push(keys.renew_client(name)?);
        }
        make(&keys, hosts, clients, made, *days)
    }
}

fn make(
    keys: &Keys,
    hosts: &[String],
    clients: &[(String, Role)],
    mut made: Vec<Files>,
    days: u32,
) -> anyhow::Result<ExitCode> {
    if !hosts.is_empty() {
        made.push(keys.add_server(hosts)?);
    }
    for (name, role) in clients {
        made.push(keys.add_client(name, *role)?);
    }
    if made.is_empty() {
        return Ok(ExitCode::SUCCESS);
    }
    let mut out = io::stdout().lock();
    for files in made {
        writeln!(out, "{}", files.certificate.display())?;
        writeln!(out, "{}", files.key.display())?;
    }
    eprintln!(
        "cantap: they are valid for {days} days; give each client its two files and ca.pem; anyone who has ca-key.pem can make \
         clients: keep it where nobody gets at it"
    );
    Ok(ExitCode::SUCCESS)
}

/// The server's side: its certificate and key, and the authority of its clients.
pub fn server(
    (certificate, key): &(PathBuf, PathBuf),
    authority: &Path,
    revoked: Option<&Path>,
) -> anyhow::Result<Server> {
    let files = Files { certificate: certificate.clone(), key: key.clone(), authority: authority.to_owned() };
    Ok(Server::new(&files, revoked)?)
}
