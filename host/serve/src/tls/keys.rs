//! A small certificate authority for one server and its clients: `cantap serve keygen`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use cantap_wire::message::Role;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, date_time_ymd,
};

use super::{Files, name_of};

/// How long certificates are valid.
const YEARS: i32 = 10;
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
            return Ok(Self { folder: folder.to_owned(), key: KeyPair::from_pem(&text)? });
        }
        let keys = Self { folder: folder.to_owned(), key: KeyPair::generate()? };
        let certificate = authority().self_signed(&keys.key)?;
        keys.write(AUTHORITY, &certificate.pem(), &keys.key)?;
        Ok(keys)
    }

    /// Makes the server's certificate, for all names and addresses by which clients reach it.
    pub fn add_server(&self, hosts: &[String]) -> Result<Files, KeysError> {
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
        let mut params = lasting(CertificateParams::new(hosts)?, name);
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
    let mut params = lasting(CertificateParams::default(), "authority");
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params
}

fn lasting(mut params: CertificateParams, name: &str) -> CertificateParams {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    // Whole years are enough, and one extra at the beginning allows for clocks that are behind.
    let year = 1970 + (since.as_secs() / (365 * 86_400 + 86_400 / 4)) as i32;
    params.not_before = date_time_ymd(year - 1, 1, 1);
    params.not_after = date_time_ymd(year + YEARS, 1, 1);
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
