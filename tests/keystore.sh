#!/usr/bin/env bash
# Makes what `ros2 security` makes, for tests on machines without ROS:
#   keystore.sh create KEYSTORE DOMAIN                     certificate authority and governance document
#   keystore.sh enclave KEYSTORE NAME PERMISSIONS_XML      key, certificate and signed permissions of an enclave (NAME as in /sctn/operator)
#   keystore.sh governance KEYSTORE NAME GOVERNANCE_XML    another governance document for one enclave
# DAYS: how long a certificate is valid, 3650 unless set.
set -euo pipefail
keystore=$2
days=${DAYS:-3650}

new_key() { openssl req "$@" -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -sha256 2>/dev/null; }
sign() { # DOCUMENT SIGNED
    openssl smime -sign -text -md sha256 -in "$1" -out "$2" \
        -signer "$keystore/public/permissions_ca.cert.pem" -inkey "$keystore/private/permissions_ca.key.pem"
}

case $1 in
create)
    mkdir -p "$keystore"/{public,private,enclaves}
    new_key -x509 -days "$days" -subj /CN=sctnCA -keyout "$keystore/private/ca.key.pem" -out "$keystore/public/ca.cert.pem"
    for role in identity permissions; do
        ln -s ca.cert.pem "$keystore/public/${role}_ca.cert.pem"
        ln -s ca.key.pem "$keystore/private/${role}_ca.key.pem"
    done
    sed "s/DOMAIN/$3/" > "$keystore/enclaves/governance.xml" <<'XML'
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_governance.xsd">
  <domain_access_rules>
    <domain_rule>
      <domains>
        <id>DOMAIN</id>
      </domains>
      <allow_unauthenticated_participants>false</allow_unauthenticated_participants>
      <enable_join_access_control>true</enable_join_access_control>
      <discovery_protection_kind>ENCRYPT</discovery_protection_kind>
      <liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
      <rtps_protection_kind>SIGN</rtps_protection_kind>
      <topic_access_rules>
        <topic_rule>
          <topic_expression>*</topic_expression>
          <enable_discovery_protection>true</enable_discovery_protection>
          <enable_liveliness_protection>true</enable_liveliness_protection>
          <enable_read_access_control>true</enable_read_access_control>
          <enable_write_access_control>true</enable_write_access_control>
          <metadata_protection_kind>ENCRYPT</metadata_protection_kind>
          <data_protection_kind>ENCRYPT</data_protection_kind>
        </topic_rule>
      </topic_access_rules>
    </domain_rule>
  </domain_access_rules>
</dds>
XML
    sign "$keystore/enclaves/governance.xml" "$keystore/enclaves/governance.p7s"
    ;;
enclave)
    folder=$keystore/enclaves$3
    mkdir -p "$folder"
    for file in identity_ca.cert.pem permissions_ca.cert.pem; do
        ln -s "$(realpath "$keystore")/public/$file" "$folder/$file"
    done
    ln -s "$(realpath "$keystore")/enclaves/governance.p7s" "$folder/governance.p7s"
    new_key -subj "/CN=${3//\//\\/}" -keyout "$folder/key.pem" -out "$folder/request.pem"
    openssl x509 -req -days "$days" -sha256 -in "$folder/request.pem" -out "$folder/cert.pem" -CAcreateserial \
        -CA "$keystore/public/identity_ca.cert.pem" -CAkey "$keystore/private/identity_ca.key.pem" 2>/dev/null
    cp "$4" "$folder/permissions.xml"
    sign "$folder/permissions.xml" "$folder/permissions.p7s"
    ;;
governance)
    rm "$keystore/enclaves$3/governance.p7s"
    sign "$4" "$keystore/enclaves$3/governance.p7s"
    ;;
*)
    echo "keystore.sh: create, enclave or governance expected, not $1" >&2
    exit 2
    ;;
esac
