// The device's half of the motorid line protocol, version 1. Plain C++11, no Arduino in it: it compiles on any
// board and on a computer, where the project's tests talk to it. What it says and hears is told in ../README.md.
#pragma once
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

namespace motorid {

// CRC-16/CCITT-FALSE; crc16("123456789", 9) is 0x29B1.
inline uint16_t crc16(const char *s, size_t n) {
  uint16_t crc = 0xFFFF;
  while (n--) {
    crc ^= (uint16_t)((uint8_t)*s++) << 8;
    for (int k = 0; k < 8; k++) crc = crc & 0x8000 ? (uint16_t)(crc << 1) ^ 0x1021 : (uint16_t)(crc << 1);
  }
  return crc;
}

struct Config {
  const char *name;      // without , $ *
  uint32_t rate;         // samples per second
  int32_t max_mV;        // the board's own limits, which no command can raise
  int32_t max_mA;
  const char *channels;  // name:unit:scale:offset:kind, as in "v:V:0.001:0:n,i:A:0.00488:2048:a12"
  float mA_per_count;    // of the current converter, for the limit
  int32_t zero_count;    // its reading at no current
};

class Bench {
 public:
  typedef void (*Send)(const char *line);  // a whole line, newline included; may drop it if nobody reads
  static const int kSegments = 32, kLongest = 240;
  static const uint32_t kSilence_us = 1000000;  // without a word from the computer: off

  Bench(const Config &c, Send send) : c_(c), send_(send), limit_mV_(c.max_mV), limit_mA_(c.max_mA) {}

  bool running() const { return running_; }
  uint32_t start_us() const { return start_us_; }  // of the first sample of the run

  void header() {
    say("H,1,%s,%lu,32,32,%g,%g,%d,%s", c_.name, (unsigned long)c_.rate, c_.max_mV / 1e3, c_.max_mA / 1e3,
        kSegments, c_.channels);
  }

  // One byte from the computer, at device time `us`.
  void receive(char ch, uint32_t us) {
    if (ch == '$') { n_ = 0; in_ = true; return; }
    if (!in_) return;
    line_[n_++] = ch;
    char *star = n_ >= 5 && line_[n_ - 5] == '*' ? line_ + n_ - 5 : nullptr;
    if (star) {
      in_ = false;
      line_[n_] = 0;
      char told[5];
      snprintf(told, sizeof told, "%04X", crc16(line_, star - line_));
      *star = 0;
      if (!memcmp(told, star + 1, 4)) { heard_us_ = us; obey(us); }
    } else if (n_ > kLongest + 4) {
      in_ = false;
    }
  }

  // Off when the computer is gone. Call it in every turn of the loop.
  void watch(uint32_t us) {
    if (running_ && us - heard_us_ > kSilence_us) stop("silent");
  }

  // The red button.
  void emergency() {
    if (running_) stop("emergency");
  }

  // Voltage to apply from now on, in mV; 0 when nothing runs. Call it once per sample, before sample().
  int32_t next_mV() {
    while (running_ && segments_ && at_ >= count(program_[which_])) {
      if (++which_ >= segments_) { which_ = 0; stop("end"); return 0; }
      enter();
    }
    if (!running_ || !segments_) return 0;
    int32_t mV = value(program_[which_]);
    return mV > limit_mV_ ? limit_mV_ : mV < -limit_mV_ ? -limit_mV_ : mV;
  }

  // Report one sample: when, what is applied from now on, and what was read.
  void sample(uint32_t us, int32_t mV, int32_t current, int32_t angle) {
    if (!running_) return;
    say("D,%lu,%lu,%ld,%ld,%ld", (unsigned long)counter_++, (unsigned long)us, (long)mV, (long)current, (long)angle);
    at_++;
    made_++;
    float mA = fabsf((current - c_.zero_count) * c_.mA_per_count);
    over_ = mA > limit_mA_ ? over_ + 1 : 0;
    if (over_ >= 3) stop("limit");
  }

 private:
  struct Segment { char shape; uint32_t ms; int32_t a[4]; };

  void obey(uint32_t us) {
    long x[7] = {0};
    char shape = 0;
    switch (line_[0]) {
      case '?': header(); break;
      case 'X': stop("stop"); break;
      case 'K': if (!running_) done(); break;
      case 'L':
        if (running_ || sscanf(line_, "L,%ld,%ld", x, x + 1) != 2) { refuse("limits"); break; }
        limit_mV_ = x[0] < c_.max_mV ? x[0] : c_.max_mV;
        limit_mA_ = x[1] < c_.max_mA ? x[1] : c_.max_mA;
        segments_ = 0;
        armed_ = true;
        say("A,L,%ld,%ld", (long)limit_mV_, (long)limit_mA_);
        break;
      case 'S': {
        int got = sscanf(line_, "S,%ld,%c,%ld,%ld,%ld,%ld,%ld", x, &shape, x + 1, x + 2, x + 3, x + 4, x + 5);
        if (!armed_ || x[0] < 0 || x[0] > segments_ || x[0] >= kSegments) { refuse("segment out of turn"); break; }
        Segment s = {shape, (uint32_t)x[1], {(int32_t)x[2], (int32_t)x[3], (int32_t)x[4], (int32_t)x[5]}};
        bool known = (shape == 'R' && got == 5) || ((shape == 'C' || shape == 'P') && got == 7);
        if (!known || x[1] < 1 || (shape == 'P' && (x[4] < 1 || x[5] < 1))) { refuse("segment"); break; }
        if (peak(s) > limit_mV_) { refuse("voltage limit"); break; }
        program_[x[0]] = s;
        segments_ = (int)x[0] + 1;
        say("A,S,%ld", x[0]);
        break;
      }
      case 'G':
        if (armed_) {
          if (sscanf(line_, "G,%ld", x) != 1 || x[0] != segments_) { refuse("segments are missing"); break; }
          armed_ = false;
          running_ = true;
          which_ = over_ = 0;
          made_ = 0;
          start_us_ = us;
          first_ = counter_;
          enter();
        }
        say("A,G,%lu,%lu", (unsigned long)first_, (unsigned long)start_us_);
        break;
      default: refuse("unknown command");
    }
  }

  void enter() { at_ = bit_ = 0; lfsr_ = program_[which_].a[3]; }
  uint32_t count(const Segment &s) const {
    uint32_t n = (uint32_t)((uint64_t)s.ms * c_.rate / 1000.0 + 0.5);
    return n ? n : 1;
  }
  static int32_t peak(const Segment &s) {
    int32_t a = labs(s.a[0]), b = labs(s.a[1]);
    return s.shape == 'R' ? (a > b ? a : b) : a + b;
  }
  int32_t value(const Segment &s) {
    double t = at_ / (double)c_.rate, T = s.ms / 1e3;
    if (s.shape == 'R') return lround(s.a[0] + (s.a[1] - s.a[0]) * (t < T ? t / T : 1.0));
    if (s.shape == 'C') {
      double f1 = s.a[2] / 1e3, f2 = s.a[3] / 1e3;
      return lround(s.a[0] + s.a[1] * sin(6.283185307179586 * (f1 * t + (f2 - f1) * t * t / (2 * T))));
    }
    for (uint32_t bit = (uint32_t)(t * 1e6 + 0.5) / s.a[2]; bit_ < bit; bit_++)
      lfsr_ = (lfsr_ >> 1) | (((lfsr_ ^ (lfsr_ >> 1)) & 1) << 14);
    return s.a[0] + (lfsr_ & 1 ? s.a[1] : -s.a[1]);
  }

  void stop(const char *why) {
    if (running_) { running_ = false; why_ = why; }
    done();
  }
  void done() { say("E,done,%lu,%s", (unsigned long)made_, why_); }
  void refuse(const char *why) { say("E,refused,%s", why); }

  template <typename... Args> void say(const char *format, Args... args) {
    char out[kLongest + 8] = "$";
    int n = snprintf(out + 1, kLongest + 1, format, args...);
    if (n > kLongest) n = kLongest;
    snprintf(out + 1 + n, 7, "*%04X\n", crc16(out + 1, n));
    send_(out);
  }

  Config c_;
  Send send_;
  char line_[kLongest + 6];
  int n_ = 0;
  bool in_ = false, armed_ = false, running_ = false;
  int32_t limit_mV_, limit_mA_;
  Segment program_[kSegments] = {};
  int segments_ = 0, which_ = 0, over_ = 0;
  uint32_t at_ = 0, bit_ = 0, lfsr_ = 1, made_ = 0, counter_ = 0, first_ = 0, start_us_ = 0, heard_us_ = 0;
  const char *why_ = "end";
};

}  // namespace motorid
