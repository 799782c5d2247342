//
// DDS Security spec v1.1
//
// Section "9.4.1.1 Permissions CA Certificate
//
// This is an X.509 certificate that contains the Public Key of the CA that will
// be used to sign the Domain Governance and Domain Permissions document. The
// certificate can be self-signed or signed by some other CA. Regardless of
// this the Public Key in the Certificate shall be trusted to sign the
// aforementioned Governance and Permissions documents (see 9.4.1.2 and
// 9.4.1.3). The Permissions CA Certificate shall be provided to the plugins
// using the PropertyQosPolicy on the DomainParticipantQos as specified in
// Table 56."
//

// So this type is to be used to verify both Domain Governance and Domain
// Permissions documents. The verification of the two can use the same or
// different Certificate instances.

use std::time::SystemTime;

use bytes::Bytes;
use der::{
  asn1::{Any, BitString, ObjectIdentifier},
  pem::{self, LineEnding},
  Decode, Encode, Sequence,
};

use crate::security::{
  access_control::access_control_builtin::pkcs7_signed_data::AlgorithmIdentifier,
  authentication::authentication_builtin::types::ECDSA_SIGNATURE_ALGO_NAME,
  config::{parse_config_error, to_config_error_parse, ConfigError},
  types::{security_error, SecurityResult},
};

const EC_PUBLIC_KEY: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.10045.2.1");
const PRIME256V1: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.10045.3.1.7");
const ECDSA_WITH_SHA256: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.10045.4.3.2");

// RFC 5280 Certificate. What is signed are the bytes of the first part, so it is
// kept as it is.
#[derive(Sequence)]
struct SignedCertificate {
  tbs_certificate: Any,
  signature_algorithm: AlgorithmIdentifier,
  signature: BitString,
}

/// An X.509 certificate of an ECDSA key over the curve P-256, signed by such a
/// key with SHA-256. The other algorithm of DDS Security, RSA, is refused.
#[derive(Clone, Debug)]
pub struct Certificate {
  pem: String,
  tbs_certificate: Bytes,
  signature: Bytes,
  public_key: Bytes,
  issuer_der: Vec<u8>,
  subject_der: Vec<u8>,
  subject_name: DistinguishedName,
  not_before: SystemTime,
  not_after: SystemTime,
}

impl Certificate {
  pub fn from_pem(pem_data: impl AsRef<[u8]>) -> Result<Self, ConfigError> {
    let (label, der) = pem::decode_vec(pem_data.as_ref())
      .map_err(to_config_error_parse("Cannot read the PEM of a certificate"))?;
    if label != "CERTIFICATE" {
      return Err(parse_config_error(format!(
        "Expected PEM of a CERTIFICATE, found {label}"
      )));
    }
    let parts = SignedCertificate::from_der(&der)
      .map_err(to_config_error_parse("Cannot read X.509 Certificate"))?;
    let certificate = x509_cert::certificate::Certificate::from_der(&der)
      .map_err(to_config_error_parse("Cannot read X.509 Certificate(2)"))?;
    let certificate = certificate.tbs_certificate();

    let key = certificate.subject_public_key_info();
    let curve = key
      .algorithm
      .parameters
      .as_ref()
      .and_then(|parameters| parameters.decode_as::<ObjectIdentifier>().ok());
    if key.algorithm.oid != EC_PUBLIC_KEY || curve != Some(PRIME256V1) {
      return Err(parse_config_error(format!(
        "Certificate of {}: expected an ECDSA key over P-256 (prime256v1)",
        certificate.subject()
      )));
    }
    if parts.signature_algorithm.oid != ECDSA_WITH_SHA256 {
      return Err(parse_config_error(format!(
        "Certificate of {}: expected a signature by ECDSA with SHA-256, found algorithm {}",
        certificate.subject(),
        parts.signature_algorithm.oid
      )));
    }

    let encode = to_config_error_parse("Cannot encode a part of the certificate");
    let encoded = (|| {
      Ok::<_, der::Error>((
        parts.tbs_certificate.to_der()?,
        certificate.issuer().to_der()?,
        certificate.subject().to_der()?,
        pem::encode_string("CERTIFICATE", LineEnding::LF, &der)?,
      ))
    })();
    let (tbs_certificate, issuer_der, subject_der, pem) = encoded.map_err(encode)?;

    Ok(Certificate {
      pem,
      tbs_certificate: tbs_certificate.into(),
      signature: Bytes::copy_from_slice(parts.signature.raw_bytes()),
      public_key: Bytes::copy_from_slice(key.subject_public_key.raw_bytes()),
      issuer_der,
      subject_der,
      subject_name: certificate.subject().clone().into(),
      not_before: certificate.validity().not_before.to_system_time(),
      not_after: certificate.validity().not_after.to_system_time(),
    })
  }

  pub fn to_pem(&self) -> String {
    self.pem.clone()
  }

  pub fn public_key(&self) -> &[u8] {
    &self.public_key
  }

  // name of the signature algoritm as a byte string accrding to Table 49
  // in DDS Security Spec v1.1 Section "9.3.2.5.1 HandshakeRequestMessageToken
  // objects"
  pub fn signature_algorithm_identifier(&self) -> Bytes {
    Bytes::from_static(ECDSA_SIGNATURE_ALGO_NAME)
  }

  pub fn subject_name(&self) -> &DistinguishedName {
    &self.subject_name
  }

  pub fn subject_name_der(&self) -> &[u8] {
    &self.subject_der
  }

  pub fn verify_signed_data_with_algorithm(
    &self,
    signed_data: impl AsRef<[u8]>,
    signature: impl AsRef<[u8]>,
    verify_algorithm: &'static dyn ring::signature::VerificationAlgorithm,
  ) -> SecurityResult<()> {
    ring::signature::UnparsedPublicKey::new(verify_algorithm, &self.public_key)
      .verify(signed_data.as_ref(), signature.as_ref())
      .map_err(|_| security_error("Signature verification failure"))
  }

  // Verify that `self` was signed by `other` Certificate, and that both are valid
  // now, e.g.
  // `someones_identity.verify_signed_by_certificate( certificate_authority )`
  //
  pub fn verify_signed_by_certificate(&self, other: &Certificate) -> SecurityResult<()> {
    if self.issuer_der != other.subject_der {
      return Err(security_error(&format!(
        "Certificate of {} was not issued by {}",
        self.subject_name, other.subject_name
      )));
    }
    other.verify_signed_data_with_algorithm(
      &self.tbs_certificate,
      &self.signature,
      &ring::signature::ECDSA_P256_SHA256_ASN1,
    )?;
    self.verify_validity()?;
    other.verify_validity()
  }

  fn verify_validity(&self) -> SecurityResult<()> {
    let now = SystemTime::now();
    if now < self.not_before || self.not_after < now {
      return Err(security_error(&format!(
        "Certificate of {} is not valid now, but from {} to {}",
        self.subject_name,
        chrono::DateTime::<chrono::Utc>::from(self.not_before),
        chrono::DateTime::<chrono::Utc>::from(self.not_after)
      )));
    }
    Ok(())
  }
}

// This represents X.501 Distinguished Name
//
// See https://datatracker.ietf.org/doc/html/rfc4514
//
// It is supposed to be a structured type of key-value-mappings,
// but for simplicity, we treat it just as a string for time being.
// It is needs to process "Subject Name" and "Issuer Name" in
// X.509 Certificates.
//
// Structured representation would allow standards-compliant
// equality comparison (`.matches()`) according to
// https://datatracker.ietf.org/doc/html/rfc5280#section-7.1
//
// TODO: Implement the structured format and matching.
#[derive(Debug, Clone)]
pub struct DistinguishedName(x509_cert::name::DistinguishedName);
impl DistinguishedName {
  pub fn parse(s: &str) -> Result<DistinguishedName, ConfigError> {
    x509_cert::name::DistinguishedName::from_str(s)
      .map(DistinguishedName)
      .map_err(|e| ConfigError::Parse(format!("Error parsing DistinguishedName: {e:?}")))
  }

  pub fn serialize(&self) -> String {
    // This returns the RFC 4514 Distinguished Name string representation
    self.0.to_string()
  }

  // TODO is this a too strict equivalence?
  pub fn matches(&self, other: &Self) -> bool {
    self.0 == other.0
  }
}

// This conversion should be non-fallible?
impl From<x509_cert::name::Name> for DistinguishedName {
  fn from(name: x509_cert::name::Name) -> DistinguishedName {
    DistinguishedName(name.into())
  }
}

use std::{fmt, str::FromStr};

impl fmt::Display for DistinguishedName {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> Result<(), fmt::Error> {
    write!(f, "{}", self.serialize())
  }
}

#[cfg(test)]
mod tests {
  use super::*;

  #[test]
  pub fn parse_example() {
    let cert_pem = r#"-----BEGIN CERTIFICATE-----
MIIBOzCB4qADAgECAhR361786/qVPfJWWDw4Wg5cmJUwBTAKBggqhkjOPQQDAjAS
MRAwDgYDVQQDDAdzcm9zMkNBMB4XDTIzMDcyMzA4MjgzNloXDTMzMDcyMTA4Mjgz
NlowEjEQMA4GA1UEAwwHc3JvczJDQTBZMBMGByqGSM49AgEGCCqGSM49AwEHA0IA
BMpvJQ/91ZqnmRRteTL2qaEFz2d7SGAQQk9PIhhZCV1tlLwYf/hI4xWLJaEv8FxJ
TjxXRGJ1U+/IqqqIvJVpWaSjFjAUMBIGA1UdEwEB/wQIMAYBAf8CAQEwCgYIKoZI
zj0EAwIDSAAwRQIgEiyVGRc664+/TE/HImA4WNwsSi/alHqPYB58BWINj34CIQDD
iHhbVPRB9Uxts9CwglxYgZoUdGUAxreYIIaLO4yLqw==
-----END CERTIFICATE-----
"#;

    let cert = Certificate::from_pem(cert_pem).unwrap();

    println!("{cert:?}");
  }
}
