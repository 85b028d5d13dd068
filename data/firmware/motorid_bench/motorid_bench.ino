// A motor bench for motorid on a Raspberry Pi Pico (RP2040, arduino-pico core); see ../README.md for the wiring.
//
//   GP2, GP3   H-bridge IN1, IN2 (DRV8871 or alike), 20 kHz PWM, slow decay: the terminals see 0 V or the supply
//   GP6, GP7   quadrature encoder A, B (3.3 V! a 5 V encoder needs a divider), both edges of both counted
//   GP26       output of the shunt amplifier (INA240A1 with 10 mΩ, reference at half the supply) to the 12-bit ADC
//   GP15       emergency stop to ground, normally closed: open means off
//
// SAFETY: the two limits below are enforced here, whatever the computer says. Set them to what your motor and
// supply stand, keep clear of the shaft, fuse the supply, and wire the emergency stop.
#include "bench_protocol.h"

const int IN1 = 2, IN2 = 3, ENC_A = 6, ENC_B = 7, CURRENT = 26, STOP = 15;
const int32_t SUPPLY_MV = 12000;
const uint32_t RATE = 1000;  // up to 5000
const motorid::Config config = {
    "pico bench", RATE, /* max_mV */ 10000, /* max_mA */ 3000,
    // 20 V/V over 10 mΩ is 0.2 V/A; one count is 3.3 V / 4096 / 0.2 V/A. 1024-line encoder: 2π / 4096 rad.
    "v:V:0.001:0:n,i:A:0.00402832:2048:a12,theta:rad:0.001533981:0:w32", 4.02832f, 2048};

volatile int32_t angle = 0;
void turned() {  // Gray code: the sign of the step follows from the state before and after
  static const int8_t STEP[16] = {0, 1, -1, 0, -1, 0, 0, 1, 1, 0, 0, -1, 0, -1, 1, 0};
  static uint8_t state = 0;
  state = (state << 2 | digitalRead(ENC_A) << 1 | digitalRead(ENC_B)) & 15;
  angle += STEP[state];
}

void apply(int32_t mV) {
  int duty = constrain((int64_t)labs(mV) * 4095 / SUPPLY_MV, 0, 4095);
  analogWrite(IN1, mV >= 0 ? 4095 : 4095 - duty);  // both high joins the terminals
  analogWrite(IN2, mV >= 0 ? 4095 - duty : 4095);
}

void release() {  // both low: the bridge is open
  analogWrite(IN1, 0);
  analogWrite(IN2, 0);
}

void send(const char *line) {  // never wait for the computer: a line that does not fit shows as a gap
  if (Serial.availableForWrite() >= (int)strlen(line)) Serial.write(line);
}

motorid::Bench bench(config, send);

void setup() {
  release();
  analogWriteFreq(20000);
  analogWriteRange(4095);
  analogReadResolution(12);
  for (int pin : {ENC_A, ENC_B, STOP}) pinMode(pin, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(ENC_A), turned, CHANGE);
  attachInterrupt(digitalPinToInterrupt(ENC_B), turned, CHANGE);
  Serial.begin(115200);  // over USB the rate does not matter
  bench.header();        // tells a recorder that the board has restarted
}

void loop() {
  static uint32_t next = 0;
  static bool was = false;
  while (Serial.available()) bench.receive(Serial.read(), micros());
  bench.watch(micros());
  if (digitalRead(STOP) == HIGH) bench.emergency();
  if (!bench.running()) {
    if (was) release();
    was = false;
    return;
  }
  if (!was) next = bench.start_us();
  was = true;
  uint32_t now = micros();
  if ((int32_t)(now - next) < 0) return;
  next += 1000000 / RATE;
  int32_t current = analogRead(CURRENT), where = angle, mV = bench.next_mV();
  if (!bench.running()) return;  // that was the end of the program
  apply(mV);
  bench.sample(now, mV, current, where);
}
