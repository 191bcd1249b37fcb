//! A small certificate authority for one server and its clients: `cantap serve keygen`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use cantap_wire::message::Role;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, date_time_ymd,
};

use super::{Files, name_of};

/// How long the authority's certificate is valid, in days.
const AUTHORITY_DAYS: u32 = 10 * 365;
/// How long other certificates are valid unless told otherwise, in days.
pub const LIFETIME_DAYS: u32 = 365;
/// A clock may be behind by this much, in seconds.
const ALLOWANCE_S: u64 = 86_400;
/// The name of the server's files.
const SERVER: &str = "server";
/// The name of the authority's files.
const AUTHORITY: &str = "ca";

/// Why keys could not be made.
#[derive(Debug, thiserror::Error)]
pub enum KeysError {
    /// The name cannot be used for files.
    #[error("'{0}' is not a name for a key; use letters, digits, - and _")]
    Name(String),
    /// The file exists; nothing is overwritten.
    #[error("'{}' already exists; choose another name, or another folder", .0.display())]
    There(PathBuf),
    /// A server's certificate must be for a name, or whoever has it could stand in for all.
    #[error("'{0}' is not the name or address of one computer; name each by which clients reach the server")]
    Host(String),
    /// A file could not be written or read.
    #[error("'{}': {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The key or certificate could not be made.
    #[error("a certificate cannot be made: {0}")]
    Certificate(#[from] rcgen::Error),
}

/// A folder with the key of an authority, that of a server, and those of clients.
pub struct Keys {
    folder: PathBuf,
    key: KeyPair,
    days: u32,
}

impl Keys {
    /// The authority in a folder, created if there is none. Its key can make new clients, so it is best kept elsewhere.
    pub fn in_folder(folder: &Path) -> Result<Self, KeysError> {
        let failed = |source| KeysError::File { path: folder.to_owned(), source };
        std::fs::create_dir_all(folder).map_err(failed)?;
        let path = folder.join(format!("{AUTHORITY}-key.pem"));
        if path.exists() {
            let text = std::fs::read_to_string(&path)
                .map_err(|source| KeysError::File { path: path.clone(), source })?;
            let key = KeyPair::from_pem(&text)?;
            return Ok(Self { folder: folder.to_owned(), key, days: LIFETIME_DAYS });
        }
        let keys = Self { folder: folder.to_owned(), key: KeyPair::generate()?, days: LIFETIME_DAYS };
        let certificate = authority().self_signed(&keys.key)?;
        keys.write(AUTHORITY, &certificate.pem(), &keys.key)?;
        Ok(keys)
    }

    /// The certificates made from now on are valid for so many days.
    #[must_use]
    pub fn lasting(self, days: u32) -> Self {
        Self { days, ..self }
    }

    /// Makes the server's certificate, for all names and addresses by which clients reach it. Wildcards are refused.
    pub fn add_server(&self, hosts: &[String]) -> Result<Files, KeysError> {
        if let Some(bad) = hosts.iter().find(|host| host.is_empty() || host.contains(['*', ' ', ','])) {
            return Err(KeysError::Host(bad.clone()));
        }
        self.add(SERVER, hosts.to_vec(), ExtendedKeyUsagePurpose::ServerAuth)
    }

    /// Makes a client's certificate, which contains its maximum role.
    pub fn add_client(&self, name: &str, role: Role) -> Result<Files, KeysError> {
        let is_plain = |letter: char| letter.is_ascii_alphanumeric() || matches!(letter, '-' | '_');
        if name.is_empty() || !name.chars().all(is_plain) || name.ends_with("-key") {
            return Err(KeysError::Name(name.to_owned()));
        }
        self.add(name, vec![name_of(role)], ExtendedKeyUsagePurpose::ClientAuth)
    }

    /// The files with a name, together with the authority's certificate.
    pub fn files(folder: &Path, name: &str) -> Files {
        Files {
            certificate: folder.join(format!("{name}.pem")),
            key: folder.join(format!("{name}-key.pem")),
            authority: folder.join(format!("{AUTHORITY}.pem")),
        }
    }

    fn add(
        &self,
        name: &str,
        hosts: Vec<String>,
        purpose: ExtendedKeyUsagePurpose,
    ) -> Result<Files, KeysError> {
        let key = KeyPair::generate()?;
        let mut params = lasting(CertificateParams::new(hosts)?, name, self.days);
        params.extended_key_usages = vec![purpose];
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.use_authority_key_identifier_extension = true;
        let certificate = params.signed_by(&key, &Issuer::from_params(&authority(), &self.key))?;
        self.write(name, &certificate.pem(), &key)?;
        Ok(Self::files(&self.folder, name))
    }

    fn write(&self, name: &str, certificate: &str, key: &KeyPair) -> Result<(), KeysError> {
        let files = Self::files(&self.folder, name);
        // Neither of the two is left alone.
        if let Some(there) = [&files.key, &files.certificate].into_iter().find(|path| path.exists()) {
            return Err(KeysError::There(there.clone()));
        }
        for (path, text, is_secret) in
            [(files.key, key.serialize_pem(), true), (files.certificate, certificate.to_owned(), false)]
        {
            create(&path, &text, is_secret).map_err(|source| match source.kind() {
                io::ErrorKind::AlreadyExists => KeysError::There(path),
                _ => KeysError::File { path, source },
            })?;
        }
        Ok(())
    }
}

/// The same every time: certificates refer to it by this, and by its key.
fn authority() -> CertificateParams {
    let mut params = lasting(CertificateParams::default(), "authority", AUTHORITY_DAYS);
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params
}

fn lasting(mut params: CertificateParams, name: &str, days: u32) -> CertificateParams {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let at = |seconds: u64| date_time_ymd(1970, 1, 1) + Duration::from_secs(seconds);
    params.not_before = at(now.as_secs().saturating_sub(ALLOWANCE_S));
    params.not_after = at(now.as_secs() + u64::from(days) * 86_400);
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::OrganizationName, "cantap");
    params.distinguished_name.push(DnType::CommonName, name);
    params
}

/// Writes a file that must not exist yet; a secret one is readable only by this user.
fn create(path: &Path, text: &str, is_secret: bool) -> io::Result<()> {
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, if is_secret { 0o600 } else { 0o644 });
    #[cfg(not(unix))]
    let _ = is_secret;
    options.open(path)?.write_all(text.as_bytes())
}
