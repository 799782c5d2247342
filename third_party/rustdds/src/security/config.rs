use std::{
  borrow::Borrow,
  path::{Path, PathBuf},
};

use crate::{
  create_security_error_and_log, qos, security,
  security::{certificate::Certificate, private_key::PrivateKey, SecurityError, SecurityResult},
};
use super::{
  access_control::access_control_builtin::{
    s_mime_config_parser::SignedDocument,
    types::{
      QOS_GOVERNANCE_DOCUMENT_PROPERTY_NAME, QOS_PERMISSIONS_CERTIFICATE_PROPERTY_NAME,
      QOS_PERMISSIONS_DOCUMENT_PROPERTY_NAME,
    },
  },
  authentication::authentication_builtin::types::{
    QOS_IDENTITY_CA_PROPERTY_NAME, QOS_IDENTITY_CERTIFICATE_PROPERTY_NAME,
    QOS_PRIVATE_KEY_PROPERTY_NAME,
  },
};

/// This holds the paths to files that configure DDS Security.
pub struct DomainParticipantSecurityConfigFiles {
  /// CA that is used to validate identities of DomainParticipants
  pub identity_ca_certificate: PathBuf,
  /// Identity docuemnt for this Participant
  pub participant_identity_certificate: PathBuf,
  /// Private (signing) key for this participant: a PEM file, not encrypted
  pub participant_identity_private_key: PathBuf,
  /// CA that is used to validate permissions documents. May be the same as
  /// Identity CA above.
  pub permissions_ca_certificate: PathBuf,
  /// Access permissions/rules for the DDS Domains to be joined.
  pub domain_governance_document: PathBuf,
  /// Access control rules for topics and participants.
  pub participant_permissions_document: PathBuf,
  /// CRLs are not yet implemented.
  pub certificate_revocation_list: Option<PathBuf>,
}

impl DomainParticipantSecurityConfigFiles {
  /// Assign some default names to security config files. The private key is not
  /// encrypted: a password is of no use.
  pub fn with_ros_default_names(
    security_config_dir: impl AsRef<Path>,
    _private_key_password: String,
  ) -> Self {
    let d = security_config_dir;

    // The default names are taken from
    // https://github.com/ros2/rmw_dds_common/blob/6fae970a99c3d4e0684a6e987edb89505b8ee213/rmw_dds_common/src/security.cpp#L25
    DomainParticipantSecurityConfigFiles {
      identity_ca_certificate: own_and_append(&d, "identity_ca.cert.pem"),
      participant_identity_certificate: own_and_append(&d, "cert.pem"),
      participant_identity_private_key: own_and_append(&d, "key.pem"),
      permissions_ca_certificate: own_and_append(&d, "permissions_ca.cert.pem"),
      domain_governance_document: own_and_append(&d, "governance.p7s"),
      participant_permissions_document: own_and_append(&d, "permissions.p7s"),
      certificate_revocation_list: None, // "crl.pem"
    }
  }

  pub fn into_property_policy(self) -> qos::policy::Property {
    let value = vec![
      mk_file_prop(QOS_IDENTITY_CA_PROPERTY_NAME, &self.identity_ca_certificate),
      mk_file_prop(
        QOS_IDENTITY_CERTIFICATE_PROPERTY_NAME,
        &self.participant_identity_certificate,
      ),
      mk_file_prop(
        QOS_PRIVATE_KEY_PROPERTY_NAME,
        &self.participant_identity_private_key,
      ),
      mk_file_prop(
        QOS_PERMISSIONS_CERTIFICATE_PROPERTY_NAME,
        &self.permissions_ca_certificate,
      ),
      mk_file_prop(
        QOS_GOVERNANCE_DOCUMENT_PROPERTY_NAME,
        &self.domain_governance_document,
      ),
      mk_file_prop(
        QOS_PERMISSIONS_DOCUMENT_PROPERTY_NAME,
        &self.participant_permissions_document,
      ),
    ];

    qos::policy::Property {
      value,
      binary_value: vec![],
    }
  }
}

fn own_and_append(d: impl AsRef<Path>, f: impl AsRef<Path>) -> PathBuf {
  let mut pb = d.as_ref().to_path_buf();
  pb.push(f);
  pb
}

fn mk_file_prop(name: &str, file_path: impl AsRef<Path>) -> security::types::Property {
  let mut value = "file:".to_string();
  value.push_str(file_path.as_ref().to_string_lossy().borrow());

  security::types::Property {
    name: name.to_string(),
    value,
    propagate: false,
  }
}

use bytes::Bytes;

pub(crate) fn read_uri(uri: &str) -> Result<Bytes, ConfigError> {
  match uri.split_once(':') {
    Some(("data", content)) => Ok(Bytes::copy_from_slice(content.as_bytes())),
    Some(("file", path)) => std::fs::read(path)
      .map_err(to_config_error_other(&format!("I/O error reading {path}")))
      .map(Bytes::from),
    _ => Err(parse_config_error(
      "Config URI must begin with 'file:' or 'data:'.".to_owned(),
    )),
  }
}

/// A certificate of the security configuration; errors name its file.
pub(in crate::security) fn read_certificate(
  qos: &qos::QosPolicies,
  property: &str,
) -> SecurityResult<Certificate> {
  let uri = qos.get_property(property)?;
  read_uri(&uri)
    .and_then(Certificate::from_pem)
    .map_err(|e| create_security_error_and_log!("{uri}: {e}"))
}

/// A signed document of the security configuration, as it is and what it says;
/// errors name its file.
pub(in crate::security) fn read_signed_document<T>(
  qos: &qos::QosPolicies,
  property: &str,
  signer: &Certificate,
  parse: impl Fn(&str) -> Result<T, ConfigError>,
) -> SecurityResult<(Bytes, T)> {
  let uri = qos.get_property(property)?;
  let named = |e: &dyn fmt::Display| create_security_error_and_log!("{uri}: {e}");
  let signed = read_uri(&uri).map_err(|e| named(&e))?;
  let content = SignedDocument::from_bytes(&signed)
    .map_err(|e| named(&e))?
    .verify_signature(signer)
    .map(|content| String::from_utf8_lossy(content.as_ref()).into_owned())
    .map_err(|e| named(&e.msg))?;
  let parsed = parse(&content).map_err(|e| named(&e))?;
  Ok((signed, parsed))
}

pub(in crate::security) fn read_private_key(
  qos: &qos::QosPolicies,
  property: &str,
) -> SecurityResult<PrivateKey> {
  let uri = qos.get_property(property)?;
  read_uri(&uri)
    .and_then(PrivateKey::from_pem)
    .map_err(|e| create_security_error_and_log!("{uri}: {e}"))
}

use std::fmt::{self, Debug};

#[derive(Debug)]
pub enum ConfigError {
  Parse(String),
  Pkcs7(String),
  Security(String),
  Other(String),
}

impl fmt::Display for ConfigError {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    match self {
      ConfigError::Parse(text)
      | ConfigError::Pkcs7(text)
      | ConfigError::Security(text)
      | ConfigError::Other(text) => f.write_str(text),
    }
  }
}

impl From<glob::PatternError> for ConfigError {
  fn from(e: glob::PatternError) -> ConfigError {
    ConfigError::Parse(format!("Bad glob pattern: {e:?}"))
  }
}

impl From<serde_xml_rs::Error> for ConfigError {
  fn from(e: serde_xml_rs::Error) -> ConfigError {
    ConfigError::Parse(format!("XML parse error: {e:?}"))
  }
}

pub(crate) fn to_config_error_other<E: Debug + 'static>(
  text: &str,
) -> impl FnOnce(E) -> ConfigError + '_ {
  move |e: E| ConfigError::Other(format!("{text}: {e:?}"))
}

pub(crate) fn to_config_error_pkcs7<E: Debug + 'static>(
  text: &str,
) -> impl FnOnce(E) -> ConfigError + '_ {
  move |e: E| ConfigError::Pkcs7(format!("{text}: {e:?}"))
}

pub(crate) fn to_config_error_parse<E: Debug + 'static>(
  text: &str,
) -> impl FnOnce(E) -> ConfigError + '_ {
  move |e: E| ConfigError::Parse(format!("{text}: {e:?}"))
}

pub(crate) fn parse_config_error(text: String) -> ConfigError {
  ConfigError::Parse(text)
}

pub(crate) fn other_config_error(text: String) -> ConfigError {
  ConfigError::Other(text)
}

pub(crate) fn pkcs7_config_error(text: String) -> ConfigError {
  ConfigError::Pkcs7(text)
}
