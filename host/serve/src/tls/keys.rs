//! A small certificate authority for one server and its clients: `cantap serve keygen`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use cantap_wire::message::Role;
use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DnType, ExtendedKeyUsagePurpose,
    IsCa, Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose, RevokedCertParams, SerialNumber, date_time_ymd,
};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer};

use super::{Files, is_name, name_of, role_of};
use crate::small_file;

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
/// The file with the authority's list of revoked certificates.
pub const REVOKED: &str = "revoked.pem";

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
    /// It is no client's certificate.
    #[error("'{}' is not a client's certificate made by keygen", .0.display())]
    NotOurs(PathBuf),
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
            let text = small_file::read_text(&path)
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
        client_name(name)?;
        self.add(name, vec![name_of(role)], ExtendedKeyUsagePurpose::ClientAuth)
    }

    /// Makes a new key and certificate for a client that has one in the folder, with the same role. The old certificate stays valid until
    /// it expires.
    pub fn renew_client(&self, name: &str) -> Result<Files, KeysError> {
        client_name(name)?;
        let path = Self::files(&self.folder, name).certificate;
        let role = role_of(&certificate(&path)?).ok_or_else(|| KeysError::NotOurs(path.clone()))?;
        let key = KeyPair::generate()?;
        let certificate =
            self.certificate(name, vec![name_of(role)], ExtendedKeyUsagePurpose::ClientAuth, &key)?;
        let files = Self::files(&self.folder, name);
        replace(&files.key, &key.serialize_pem(), true)?;
        replace(&files.certificate, &certificate, false)?;
        Ok(files)
    }

    /// Adds a client's certificate to the list of those that are revoked, and returns the list's file: a server that has it lets the client in
    /// no more.
    pub fn revoke_client(&self, name: &str) -> Result<PathBuf, KeysError> {
        client_name(name)?;
        let path = Self::files(&self.folder, name).certificate;
        let der = certificate(&path)?;
        let serial = match webpki::EndEntityCert::try_from(&der) {
            Ok(certificate) if role_of(&der).is_some() => certificate.serial().to_vec(),
            _ => return Err(KeysError::NotOurs(path)),
        };
        let list = self.folder.join(REVOKED);
        let mut all = if list.exists() { revoked(&list)? } else { Vec::new() };
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        if all.iter().all(|(there, _)| *there != serial) {
            all.push((serial, now));
        }
        let entry = |(serial, at): &(Vec<u8>, u64)| RevokedCertParams {
            serial_number: SerialNumber::from_slice(serial),
            revocation_time: date_time_ymd(1970, 1, 1) + Duration::from_secs(*at),
            reason_code: None,
            invalidity_date: None,
        };
        let params = CertificateRevocationListParams {
            this_update: date_time_ymd(1970, 1, 1) + Duration::from_secs(now),
            next_update: date_time_ymd(1970, 1, 1)
                + Duration::from_secs(now + u64::from(AUTHORITY_DAYS) * 86_400),
            crl_number: SerialNumber::from(now),
            issuing_distribution_point: None,
            revoked_certs: all.iter().map(entry).collect(),
            key_identifier_method: KeyIdMethod::Sha256,
        };
        let signed = params.signed_by(&Issuer::from_params(&authority(), &self.key))?;
        replace(&list, &signed.pem()?, false)?;
        Ok(list)
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
        let certificate = self.certificate(name, hosts, purpose, &key)?;
        self.write(name, &certificate, &key)?;
        Ok(Self::files(&self.folder, name))
    }

    fn certificate(
        &self,
        name: &str,
        hosts: Vec<String>,
        purpose: ExtendedKeyUsagePurpose,
        key: &KeyPair,
    ) -> Result<String, KeysError> {
        let mut params = lasting(CertificateParams::new(hosts)?, name, self.days);
        params.extended_key_usages = vec![purpose];
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.use_authority_key_identifier_extension = true;
        Ok(params.signed_by(key, &Issuer::from_params(&authority(), &self.key))?.pem())
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

fn client_name(name: &str) -> Result<(), KeysError> {
    let is_own = [SERVER, AUTHORITY].contains(&name) || name.ends_with("-key");
    if is_name(name) && !is_own { Ok(()) } else { Err(KeysError::Name(name.to_owned())) }
}

/// The certificate in a file.
fn certificate(path: &Path) -> Result<CertificateDer<'static>, KeysError> {
    let pem = small_file::read(path).map_err(|error| unreadable(path, error))?;
    CertificateDer::from_pem_slice(&pem).map_err(|error| unreadable(path, error))
}

fn unreadable(path: &Path, error: impl std::fmt::Display) -> KeysError {
    KeysError::File { path: path.to_owned(), source: io::Error::other(error.to_string()) }
}

/// The serial numbers on a list, and when each was put there, in seconds since the Unix epoch.
fn revoked(path: &Path) -> Result<Vec<(Vec<u8>, u64)>, KeysError> {
    let pem = small_file::read(path).map_err(|error| unreadable(path, error))?;
    let der = CertificateRevocationListDer::from_pem_slice(&pem).map_err(|error| unreadable(path, error))?;
    let list = webpki::BorrowedCertRevocationList::from_der(&der).map_err(|error| unreadable(path, error))?;
    list.into_iter()
        .map(|entry| match entry {
            Ok(entry) => Ok((entry.serial_number.to_vec(), entry.revocation_date.as_secs())),
            Err(error) => Err(unreadable(path, error)),
        })
        .collect()
}

/// Puts a new content in the place of a file of ours, in one step.
fn replace(path: &Path, text: &str, is_secret: bool) -> Result<(), KeysError> {
    let new = path.with_extension("new");
    let failed = |source| KeysError::File { path: path.to_owned(), source };
    create(&new, text, is_secret).map_err(|source| match source.kind() {
        io::ErrorKind::AlreadyExists => KeysError::There(new.clone()),
        _ => failed(source),
    })?;
    std::fs::rename(&new, path).map_err(failed)
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
