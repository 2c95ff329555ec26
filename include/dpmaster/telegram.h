/* SPDX-License-Identifier: MIT
 *
 * FDL telegrams: octets to meaning and back. EN 50170 part 4; layouts in IEC 61158-4-3.
 *
 *   SD1  10 DA SA FC FCS ED                                  6 octets, no data
 *   SD2  68 LE LEr 68 DA SA FC [DAE..] [SAE..] DU.. FCS ED   LE + 6 octets, LE 4..249 (3 is accepted, never sent)
 *   SD3  A2 DA SA FC DU*8 FCS ED                             14 octets; the eight include the address extensions
 *   SD4  DC DA SA                                            token, 3 octets, no FCS, no ED
 *   SC   E5                                                  short acknowledge, 1 octet
 *
 * FCS is the sum modulo 256 of DA .. last DU octet. Bit 7 of DA says that an extension octet follows FC, bit 7 of SA
 * that one follows after it. An extension octet holds a SAP in bits 5..0, or a segment address when bit 6 is set; its
 * bit 7 says that one more follows: a segment may precede a SAP, nothing else is chained. DP uses
 * one SAP octet on both sides or none.
 */
#ifndef DPMASTER_TELEGRAM_H
#define DPMASTER_TELEGRAM_H

#include "dpmaster/api.h"

enum dpm_delimiter {
    DPM_SD1 = 0x10,
    DPM_SD2 = 0x68,
    DPM_SD3 = 0xA2,
    DPM_SD4 = 0xDC,
    DPM_SC = 0xE5,
    DPM_ED = 0x16
};

#define DPM_TELEGRAM_MAX 255 /* octets of the longest SD2 */
#define DPM_DATA_MAX 246     /* octets after FC in the longest SD2, extensions included */
#define DPM_IO_MAX 244       /* octets of inputs or outputs of a DP slave, and of any DP PDU behind two SAPs */
#define DPM_NO_SAP -1
#define DPM_BROADCAST 127
#define DPM_ADDRESS_MAX 125  /* 126 is a slave that waits for Set_Slave_Add, 127 is everybody */

/* FC of a request: bit 6 set, bit 5 FCB, bit 4 FCV, bits 3..0 the function. */
enum dpm_function {
    DPM_FC_REQUEST = 0x40,
    DPM_FC_FCB = 0x20,
    DPM_FC_FCV = 0x10,
    DPM_SDA_LOW = 0x03,
    DPM_SDN_LOW = 0x04,
    DPM_SDA_HIGH = 0x05,
    DPM_SDN_HIGH = 0x06,
    DPM_FDL_STATUS = 0x09,
    DPM_SRD_LOW = 0x0C,
    DPM_SRD_HIGH = 0x0D,
    DPM_IDENT = 0x0E,
    DPM_LSAP_STATUS = 0x0F
};

/* FC of a response: bit 6 clear, bits 5..4 the station type, bits 3..0 the result. */
enum dpm_response {
    DPM_RES_OK = 0x00,
    DPM_RES_UE = 0x01,  /* user error */
    DPM_RES_RR = 0x02,  /* no resources */
    DPM_RES_RS = 0x03,  /* service not activated: SAP closed or access denied */
    DPM_RES_DL = 0x08,  /* data, low priority */
    DPM_RES_NR = 0x09,  /* no data */
    DPM_RES_DH = 0x0A,  /* data, high priority: a DP slave has diagnosis */
    DPM_RES_RDL = 0x0C, /* data, but the request's data were not taken */
    DPM_RES_RDH = 0x0D,
    DPM_TYPE_SLAVE = 0x00,
    DPM_TYPE_MASTER_NOT_READY = 0x10,
    DPM_TYPE_MASTER_READY = 0x20,
    DPM_TYPE_MASTER_IN_RING = 0x30
};

/* DP service access points (IEC 61158-5-3); the master's side of SAP 55..62 is DPM_SAP_MASTER. */
enum dpm_sap {
    DPM_SAP_SET_SLAVE_ADD = 55,
    DPM_SAP_RD_INP = 56,
    DPM_SAP_RD_OUTP = 57,
    DPM_SAP_GLOBAL_CONTROL = 58,
    DPM_SAP_GET_CFG = 59,
    DPM_SAP_SLAVE_DIAG = 60,
    DPM_SAP_SET_PRM = 61,
    DPM_SAP_CHK_CFG = 62,
    DPM_SAP_MASTER = 62
};

/* Why octets are not a telegram; also the index of the receiver's counters. */
enum dpm_reject {
    DPM_REJECT_DELIMITER = 1, /* no telegram begins with this octet */
    DPM_REJECT_LENGTH,        /* LE outside 3..249 */
    DPM_REJECT_LENGTH_TWICE,  /* LE and LEr differ */
    DPM_REJECT_DELIMITER_2,   /* the second start delimiter of SD2 is not 68 */
    DPM_REJECT_FCS,           /* the sum is wrong */
    DPM_REJECT_END,           /* the end delimiter is not 16 */
    DPM_REJECT_ADDRESS,       /* SA 127, or a token from or for an address above 125 */
    DPM_REJECT_EXTENSION,     /* extensions that run past the telegram, or chains other than segment, SAP */
    DPM_REJECT_LINE,          /* an octet came with a line error: parity, framing, overrun or break */
    DPM_REJECT_GAP,           /* certain pause inside a telegram */
    DPM_REJECT_INCOMPLETE,    /* the bus fell silent before the telegram was whole */
    DPM_REJECT_COUNT
};

/* One telegram. `data` points into the octets that were decoded, or to the caller's data when encoding. */
typedef struct dpm_telegram {
    uint8_t format;    /* enum dpm_delimiter; 0 when encoding: SD1 without data and SAPs, else SD2 */
    uint8_t da;        /* 0..127 */
    uint8_t sa;        /* 0..126 */
    uint8_t fc;
    int16_t dsap;      /* 0..63, or DPM_NO_SAP */
    int16_t ssap;
    int16_t dsegment;  /* segment address of the extension, 0..63, or -1 */
    int16_t ssegment;
    uint8_t length;    /* octets of data, 0..246 less the extensions */
    const uint8_t *data;
} dpm_telegram;

/* Decode what begins at octets[0].
 * Returns the octets consumed (1..255) when they are a good telegram, 0 when more octets are needed to tell, or
 * -(enum dpm_reject) as soon as it is certain that no good telegram begins here. Only a good telegram is
 * written to *telegram. */
DPM_API int dpm_decode(const uint8_t *octets, size_t n, dpm_telegram *telegram);

/* Encode `telegram` into out[0..size). Returns the octets written, or DPM_E_ARGUMENT, DPM_E_ADDRESS, DPM_E_LENGTH.
 * What dpm_decode would not give back field by field is refused: data in an SD1, other than eight octets behind FC in
 * an SD3, nothing behind FC in an SD2, anything but addresses in a token, anything at all in an SC. */
DPM_API int dpm_encode(const dpm_telegram *telegram, uint8_t *out, size_t size);

/* A short name of a reject reason for counters and messages: "FCS", "length twice", ... */
DPM_API const char *dpm_reject_name(int reason);

#endif
